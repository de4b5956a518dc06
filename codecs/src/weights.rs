//! Weight codecs: a deformer's weights as float32, as 16-bit floats, or as 8-bit integers with a scale per row.

use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{StreamSet, read_shapes, value_count, write_shapes};
use cc4dgs_format::{CodecContext, Error, Plugin, Result, Stream, WeightArray, WeightCodec, WeightCodecPlugin, config, inventory};
use half::f16;
use serde::Deserialize;

/// Values per scale in `int8`.
const ROW: usize = 64;
/// Largest 8-bit code.
const PEAK: f32 = 127.0;
/// Largest scale of a row: files may hold the code -128, too.
const MOST_SCALE: f32 = f32::MAX / 128.0;
/// The one stream: names and shapes, then all values.
const WEIGHTS: &str = "weights";

/// How a value is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Precision {
    /// float32, bit-exact.
    Fp32,
    /// 16-bit floats.
    Fp16,
    /// 8-bit integers, a float32 scale per 64 values.
    Int8,
}

impl Precision {
    fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp16 => "fp16",
            Self::Int8 => "int8",
        }
    }
    /// Bytes of `count` values; `None` on overflow.
    fn bytes(self, count: usize) -> Option<usize> {
        match self {
            Self::Fp32 => count.checked_mul(4),
            Self::Fp16 => count.checked_mul(2),
            Self::Int8 => count.checked_add(count.div_ceil(ROW).checked_mul(4)?),
        }
    }
    fn write(self, name: &str, values: &[f32], out: &mut Vec<u8>) -> Result<()> {
        match self {
            Self::Fp32 => out.extend(values.iter().flat_map(|v| v.to_le_bytes())),
            Self::Fp16 => {
                if let Some(v) = values.iter().find(|v| !f16::from_f32(**v).is_finite()) {
                    return Err(Error::parameter(format!("weights '{name}'"), format!("{v} is over the limit of fp16 (65,504)"), "Store the weights as fp32"));
                }
                out.extend(values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()));
            }
            Self::Int8 => {
                for row in values.chunks(ROW) {
                    let largest = row.iter().fold(0.0f32, |m, v| m.max(v.abs()));
                    let scale = largest / PEAK;
                    if scale > MOST_SCALE {
                        let problem = format!("{largest:e} is over the limit of int8 ({:e})", PEAK * MOST_SCALE);
                        return Err(Error::parameter(format!("weights '{name}'"), problem, "Store the weights as fp32"));
                    }
                    out.extend(scale.to_le_bytes());
                    // A scale that underflows to 0 means that all values are zero.
                    out.extend(row.iter().map(|v| if scale > 0.0 { (v / scale).round().clamp(-PEAK, PEAK) as i8 as u8 } else { 0 }));
                }
            }
        }
        Ok(())
    }
    fn read(self, reader: &mut ByteReader, count: usize) -> Result<Vec<f32>> {
        match self {
            Self::Fp32 => reader.f32s(count),
            Self::Fp16 => {
                let bytes = reader.take(2 * count)?;
                let values: Vec<f32> = bytes.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect();
                match values.iter().find(|v| !v.is_finite()) {
                    Some(v) => Err(reader.error(format!("a weight is {v}, which is not finite"))),
                    None => Ok(values),
                }
            }
            Self::Int8 => {
                let mut values = Vec::with_capacity(count);
                while values.len() < count {
                    let scale = reader.f32()?;
                    let row = reader.take(ROW.min(count - values.len()))?;
                    if !(0.0..=MOST_SCALE).contains(&scale) {
                        return Err(reader.error(format!("a row of weights has the scale {scale:e}, expected a number from 0 to {MOST_SCALE:e}")));
                    }
                    values.extend(row.iter().map(|&b| f32::from(b as i8) * scale));
                }
                Ok(values)
            }
        }
    }
}

impl WeightCodec for Precision {
    fn encode(&self, weights: &[WeightArray], _: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        let mut bytes = Vec::new();
        write_shapes(weights, &mut bytes)?;
        weights.iter().try_for_each(|array| self.write(&array.name, &array.values, &mut bytes))?;
        Ok(vec![Stream { name: WEIGHTS.into(), bytes }])
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>> {
        let mut reader = StreamSet::new(self.name(), streams).reader(WEIGHTS)?;
        context.limits.check_bytes("deformer weights", reader.remaining() as u64)?;
        let mut arrays = read_shapes(&mut reader, &context.limits)?;
        for array in &mut arrays {
            let fits = |n: &usize| self.bytes(*n).is_some_and(|bytes| bytes <= reader.remaining());
            let Some(length) = value_count(&array.shape).filter(fits) else {
                return Err(reader.error(format!("weights '{}' of shape {:?} do not fit the {} bytes left", array.name, array.shape, reader.remaining())));
            };
            array.values = self.read(&mut reader, length)?;
        }
        reader.finish()?;
        Ok(arrays)
    }
    fn loss(&self) -> f64 {
        match self {
            Self::Fp32 => 0.0,
            // The rounding of an 11-bit significand. Values below 2^-14 are rounded to multiples of 2^-24, which is no more beside a largest value from 2^-14
            // on.
            Self::Fp16 => 1.0 / 2048.0,
            // Half a step, plus the rounding of the scale.
            Self::Int8 => 0.5 / 127.0 + 1e-5,
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {}

fn build(precision: Precision, settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
    let Settings {} = config::parse_section(&format!("weight-codec {}", precision.name()), settings)?;
    Ok(Box::new(precision))
}

/// Keeps the plug-ins of this module in the program; see [`crate::link`].
pub(crate) fn build_fp32(settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
    build(Precision::Fp32, settings)
}

inventory::submit! {
    WeightCodecPlugin {
        info: Plugin {
            name: "fp32",
            version: "1",
            summary: "float32, bit-exact",
            paper: "the uncompressed baseline",
            schema: "# no settings\n",
            capabilities: &["lossless"],
        },
        build: build_fp32,
    }
}

inventory::submit! {
    WeightCodecPlugin {
        info: Plugin {
            name: "fp16",
            version: "1",
            summary: "16-bit floats",
            paper: "IEEE 754 binary16",
            schema: "# no settings\n",
            capabilities: &["lossy"],
        },
        build: |settings| build(Precision::Fp16, settings),
    }
}

inventory::submit! {
    WeightCodecPlugin {
        info: Plugin {
            name: "int8",
            version: "1",
            summary: "8-bit integers, a float32 scale per 64 values",
            paper: "row-wise symmetric quantisation",
            schema: "# no settings\n",
            capabilities: &["lossy"],
        },
        build: |settings| build(Precision::Int8, settings),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::{Limits, Seed, Silent};

    #[test]
    fn each_loses_what_its_bits_say() {
        let values: Vec<f32> = (0..1000).map(|i| (i as f32 * 0.7).sin() * 0.1).collect();
        for (precision, allowed) in [(Precision::Fp32, 0.0), (Precision::Fp16, 5e-5), (Precision::Int8, 0.1 / 254.0 + 1e-7)] {
            let mut bytes = Vec::new();
            precision.write("w", &values, &mut bytes).unwrap();
            assert_eq!(Some(bytes.len()), precision.bytes(values.len()));
            let found = precision.read(&mut ByteReader::new("w", &bytes), values.len()).unwrap();
            let worst = values.iter().zip(&found).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst <= allowed, "{}: {worst}", precision.name());
        }
        assert!(Precision::Fp16.write("w", &[1e6], &mut Vec::new()).is_err());
        assert!(Precision::Int8.read(&mut ByteReader::new("w", &[0, 0, 192, 127, 5]), 1).is_err(), "a scale that is not a number");
        let mut bytes = Vec::new();
        Precision::Int8.write("w", &[PEAK * 0.99 * MOST_SCALE], &mut bytes).unwrap();
        assert!(Precision::Int8.read(&mut ByteReader::new("w", &bytes), 1).unwrap()[0].is_finite());
        let error = Precision::Int8.write("w", &[1.0, -f32::MAX], &mut Vec::new()).unwrap_err().to_string();
        assert!(error.contains("weights 'w': 3.4028235e38 is over the limit of int8"), "{error}");
    }

    #[test]
    fn fp16_loses_little_beside_a_largest_value_of_full_precision() {
        let stored = |values: &[f32]| {
            let mut bytes = Vec::new();
            Precision::Fp16.write("w", values, &mut bytes).unwrap();
            Precision::Fp16.read(&mut ByteReader::new("w", &bytes), values.len()).unwrap()
        };
        let least = f16::MIN_POSITIVE.to_f32();
        for largest in [least, 1.37 * least, 1.0, 65504.0] {
            let values: Vec<f32> = std::iter::once(largest).chain((0..2000).map(|k| largest * 0.98f32.powi(k))).collect();
            let found = stored(&values);
            let worst = values.iter().zip(&found).map(|(a, b)| f64::from(a - b).abs()).fold(0.0, f64::max);
            assert!(worst <= Precision::Fp16.loss() * f64::from(largest), "{worst:e} beside {largest:e}");
        }
        // As documented, an array may become zero where all of it is smaller.
        assert_eq!(stored(&[2.9e-8, -2.9e-8]), [0.0; 2]);
        assert!(stored(&[3.1e-8]) != [0.0]);
    }

    #[test]
    fn shapes_that_the_bytes_do_not_hold_are_refused() {
        let context = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
        let weights = [WeightArray { name: "w".into(), shape: vec![2, 3], values: vec![1.0; 6] }];
        for precision in [Precision::Fp32, Precision::Fp16, Precision::Int8] {
            let mut streams = precision.encode(&weights, &context).unwrap();
            assert!(precision.decode(&streams, &context).is_ok());
            // The first dimension: behind count, length of the name, name and rank.
            streams[0].bytes[4 + 2 + 1 + 1 + 7] = 0xff;
            assert!(precision.decode(&streams, &context).unwrap_err().to_string().contains("do not fit"));
        }
    }
}
