//! Reads and writes PLY files in the layout of 3D Gaussian splatting (Inria): binary little-endian float32 properties per Gaussian.
//!
//! `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3 [dynamic]`, all before activation; `f_rest` is channel-major (all
//! coefficients of red, then green, then blue). With degree 3 that is 62 floats, 63 with Swift4D's `dynamic`. Properties are found by
//! name, so their order does not matter and normals may be missing. The number of `f_rest` (0, 9, 24, 45 or 72) gives the degree.

use crate::archive::write_atomically;
use crate::gaussians::sh_rest_len;
use crate::{Error, GaussianFile, HostGaussians, Limits, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The comment that names how viewers are to draw the model, and the mode of models that want Mip-Splatting's 2D filter.
const RENDER_MODE: &str = "SplatRenderMode:";
const ANTIALIASED: &str = "mip";
/// Largest header in bytes; 3DGS headers have about 1.5 kB.
const HEADER_LIMIT: usize = 64 << 10;

/// Reads the Gaussians of a PLY file. Unknown properties are ignored; [`read_file`] lists them.
///
/// # Errors
/// [`Error::Io`], [`Error::Data`] for invalid files, [`Error::Unsupported`] for other PLY layouts, [`Error::Limit`].
pub fn read(path: impl AsRef<Path>, limits: &Limits) -> Result<HostGaussians> {
    Ok(read_file(path, limits)?.gaussians)
}

/// Like [`read`], with what the header says of rendering, and remarks about ignored properties and missing dynamic scores.
pub fn read_file(path: impl AsRef<Path>, limits: &Limits) -> Result<GaussianFile> {
    let path = path.as_ref();
    from_bytes(&path.display().to_string(), &limits.read_file(path)?, limits)
}

/// Like [`read_file`], for a file in memory; `object` names it in errors.
pub fn from_bytes(object: &str, bytes: &[u8], limits: &Limits) -> Result<GaussianFile> {
    let header = Header::parse(object, bytes, limits)?;
    let body = &bytes[header.body..];
    let claimed = header.count as u64 * header.stride as u64;
    if (body.len() as u64) < claimed || (header.last && body.len() as u64 > claimed) {
        let problem = format!("{} Gaussians of {} bytes need {claimed} bytes, the file has {}", header.count, header.stride, body.len());
        return Err(Error::data(object, problem, "The file is truncated or its header is wrong; fetch it again"));
    }
    let layout = Layout::find(object, &header)?;
    let gaussians = layout.gather(&body[..claimed as usize], header.stride);
    gaussians.validate_read(object, limits)?;
    let mut remarks = Vec::new();
    if layout.dynamic.is_none() {
        remarks.push("there is no property 'dynamic'; all dynamic scores are 0".to_string());
    }
    if !layout.ignored.is_empty() {
        remarks.push(format!("ignored properties: {}", layout.ignored.join(", ")));
    }
    Ok(GaussianFile { gaussians, antialiased: header.antialiased, remarks })
}

/// Writes Gaussians as PLY, atomically. `include_dynamic` appends the property `dynamic`. Attributes of plug-ins are not written.
///
/// # Errors
/// [`Error::Io`], and [`Error::Data`] for invalid Gaussians.
pub fn write(path: impl AsRef<Path>, gaussians: &HostGaussians, include_dynamic: bool) -> Result<()> {
    write_atomically(path, &to_bytes(gaussians, include_dynamic)?)
}

/// The bytes that [`write()`] writes.
pub fn to_bytes(gaussians: &HostGaussians, include_dynamic: bool) -> Result<Vec<u8>> {
    to_bytes_with(gaussians, &PlyOptions { dynamic: include_dynamic, antialiased: false })
}

/// How a PLY file is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlyOptions {
    /// Append the property `dynamic`.
    pub dynamic: bool,
    /// Say in a comment that the model wants Mip-Splatting's 2D filter, as viewers expect it.
    pub antialiased: bool,
}

/// The bytes of a PLY file.
///
/// # Errors
/// [`Error::Data`] for invalid Gaussians.
pub fn to_bytes_with(gaussians: &HostGaussians, options: &PlyOptions) -> Result<Vec<u8>> {
    let include_dynamic = options.dynamic;
    gaussians.validate("Gaussians to write", &Limits { max_gaussians: u64::MAX, ..Limits::default() })?;
    let k = sh_rest_len(gaussians.sh_degree);
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).into();
    names.extend((0..3).map(|i| format!("f_dc_{i}")));
    names.extend((0..3 * k).map(|i| format!("f_rest_{i}")));
    names.push("opacity".into());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    if include_dynamic {
        names.push("dynamic".into());
    }
    let n = gaussians.len();
    let properties: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    let comment = if options.antialiased { format!("comment {RENDER_MODE} {ANTIALIASED}\n") } else { String::new() };
    let mut out = format!("ply\nformat binary_little_endian 1.0\n{comment}element vertex {n}\n{properties}end_header\n").into_bytes();
    out.reserve(4 * names.len() * n);
    for i in 0..n {
        let mut put = |values: &[f32]| values.iter().for_each(|v| out.extend(v.to_le_bytes()));
        put(&gaussians.means[3 * i..3 * i + 3]);
        put(&[0.0; 3]);
        put(&gaussians.sh_dc[3 * i..3 * i + 3]);
        let rest = &gaussians.sh_rest[3 * k * i..3 * k * (i + 1)];
        (0..3 * k).for_each(|c| put(&[rest[3 * (c % k) + c / k]]));
        put(&[gaussians.opacity_logits[i]]);
        put(&gaussians.log_scales[3 * i..3 * i + 3]);
        put(&gaussians.quaternions[4 * i..4 * i + 4]);
        if include_dynamic {
            put(&[gaussians.dynamic_scores[i]]);
        }
    }
    Ok(out)
}

/// The header's description of the element `vertex`.
struct Header {
    count: usize,
    /// Bytes per vertex.
    stride: usize,
    /// Byte offset and type by property name.
    properties: BTreeMap<String, (usize, String)>,
    /// Names in file order.
    names: Vec<String>,
    /// Whether no other element follows.
    last: bool,
    /// Byte offset of the first value.
    body: usize,
    /// Whether a comment asks for Mip-Splatting's 2D filter.
    antialiased: bool,
}

impl Header {
    fn parse(object: &str, bytes: &[u8], limits: &Limits) -> Result<Self> {
        let bad = |problem: String| Error::data(object, problem, "Give a binary PLY in the layout of 3D Gaussian splatting");
        let mut header = Self { count: 0, stride: 0, properties: BTreeMap::new(), names: Vec::new(), last: true, body: 0, antialiased: false };
        let (mut format, mut vertex) = (false, None::<bool>);
        loop {
            let head = &bytes[header.body..bytes.len().min(HEADER_LIMIT)];
            let Some(length) = head.iter().position(|&b| b == b'\n') else {
                return Err(bad(format!("the header does not end within {} bytes", bytes.len().min(HEADER_LIMIT))));
            };
            let line = std::str::from_utf8(&head[..length]).map_err(|_| bad(format!("the header is not text at byte {}", header.body)))?.trim_end();
            let first = header.body == 0;
            header.body += length + 1;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words.as_slice() {
                ["ply"] if first => {}
                _ if first => return Err(bad("the first line is not 'ply'".into())),
                ["comment", RENDER_MODE, mode] => header.antialiased = *mode == ANTIALIASED,
                ["comment" | "obj_info", ..] => {}
                ["format", "binary_little_endian", _] => format = true,
                ["format", other, ..] => {
                    return Err(Error::unsupported(object, format!("PLY format '{other}' is not supported"), "Convert the file to binary_little_endian"));
                }
                ["element", "vertex", count] if vertex.is_none() => {
                    let count: u64 = count.parse().map_err(|_| bad(format!("'{count}' is not a number of vertices")))?;
                    limits.check_gaussians(object, count)?;
                    header.count = count as usize;
                    vertex = Some(true);
                }
                ["element", name, _] if vertex.is_none() => {
                    let remedy = "Export plain 3D Gaussian splatting PLY; compressed layouts put other elements first";
                    return Err(Error::unsupported(object, format!("element '{name}' comes before the vertices"), remedy));
                }
                ["element", _, _] => {
                    vertex = Some(false);
                    header.last = false;
                }
                ["property", ..] if vertex == Some(false) => {}
                ["property", kind, name] if vertex == Some(true) => {
                    let Some(size) = type_size(kind) else {
                        return Err(bad(format!("property '{name}' has the unknown type '{kind}'")));
                    };
                    if header.properties.insert((*name).to_string(), (header.stride, (*kind).to_string())).is_some() {
                        return Err(bad(format!("property '{name}' appears twice")));
                    }
                    header.names.push((*name).to_string());
                    header.stride += size;
                }
                ["end_header"] if format && vertex.is_some() => return Ok(header),
                ["end_header"] => return Err(bad("the header has no format or no element vertex".into())),
                _ => return Err(bad(format!("the header line '{}' is not understood", line.escape_default().take(80).collect::<String>()))),
            }
        }
    }
}

fn type_size(kind: &str) -> Option<usize> {
    Some(match kind {
        "char" | "uchar" | "int8" | "uint8" => 1,
        "short" | "ushort" | "int16" | "uint16" => 2,
        "int" | "uint" | "float" | "int32" | "uint32" | "float32" => 4,
        "double" | "float64" => 8,
        _ => return None,
    })
}

/// Byte offsets of the attributes inside a vertex.
struct Layout {
    sh_degree: usize,
    means: [usize; 3],
    dc: [usize; 3],
    rest: Vec<usize>,
    opacity: usize,
    scales: [usize; 3],
    rotation: [usize; 4],
    dynamic: Option<usize>,
    ignored: Vec<String>,
}

impl Layout {
    fn find(object: &str, header: &Header) -> Result<Self> {
        let bad = |problem: String| Error::data(object, problem, "Give a PLY in the layout of 3D Gaussian splatting");
        let mut used: BTreeSet<String> = ["nx", "ny", "nz"].map(String::from).into();
        let mut offset = |name: &str| -> Result<usize> {
            used.insert(name.to_string());
            match header.properties.get(name) {
                Some((offset, kind)) if matches!(kind.as_str(), "float" | "float32") => Ok(*offset),
                Some((_, kind)) => Err(bad(format!("property '{name}' is {kind} instead of float"))),
                None => Err(bad(format!("property '{name}' is missing"))),
            }
        };
        let rest = header.names.iter().filter(|n| n.starts_with("f_rest_")).count();
        let Some(sh_degree) = (0..=4).find(|&d| 3 * sh_rest_len(d) == rest) else {
            return Err(bad(format!("{rest} properties f_rest_*, expected 0, 9, 24, 45 or 72 (spherical-harmonics degree 0 to 4)")));
        };
        let k = sh_rest_len(sh_degree);
        let mut layout = Self {
            sh_degree,
            means: [offset("x")?, offset("y")?, offset("z")?],
            dc: [offset("f_dc_0")?, offset("f_dc_1")?, offset("f_dc_2")?],
            // Coefficient-major here, channel-major in the file.
            rest: (0..rest).map(|i| offset(&format!("f_rest_{}", (i % 3) * k + i / 3))).collect::<Result<_>>()?,
            opacity: offset("opacity")?,
            scales: [offset("scale_0")?, offset("scale_1")?, offset("scale_2")?],
            rotation: [offset("rot_0")?, offset("rot_1")?, offset("rot_2")?, offset("rot_3")?],
            dynamic: header.properties.contains_key("dynamic").then(|| offset("dynamic")).transpose()?,
            ignored: Vec::new(),
        };
        layout.ignored = header.names.iter().filter(|n| !used.contains(*n)).cloned().collect();
        Ok(layout)
    }
    fn gather(&self, body: &[u8], stride: usize) -> HostGaussians {
        let mut out = HostGaussians { sh_degree: self.sh_degree, ..Default::default() };
        for vertex in body.chunks_exact(stride) {
            let float = |&at: &usize| f32::from_le_bytes([vertex[at], vertex[at + 1], vertex[at + 2], vertex[at + 3]]);
            out.means.extend(self.means.iter().map(float));
            out.sh_dc.extend(self.dc.iter().map(float));
            out.sh_rest.extend(self.rest.iter().map(float));
            out.opacity_logits.push(float(&self.opacity));
            out.log_scales.extend(self.scales.iter().map(float));
            out.quaternions.extend(self.rotation.iter().map(float));
            out.dynamic_scores.push(self.dynamic.as_ref().map_or(0.0, float));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two Gaussians in which every value is different.
    fn sample(sh_degree: usize) -> HostGaussians {
        let mut out = HostGaussians { sh_degree, opacity_logits: vec![0.0; 2], ..Default::default() };
        for (a, (_, width, values)) in out.columns_mut().into_iter().enumerate() {
            *values = (0..2 * width).map(|i| (1000 * a + i) as f32 + 0.5).collect();
        }
        out
    }

    #[test]
    fn every_degree_round_trips_with_and_without_dynamic_scores() {
        for degree in 0..=4 {
            let gaussians = sample(degree);
            let bytes = to_bytes(&gaussians, true).unwrap();
            assert_eq!(from_bytes("t", &bytes, &Limits::default()).unwrap(), GaussianFile { gaussians: gaussians.clone(), ..Default::default() });
            let bytes = to_bytes_with(&gaussians, &PlyOptions { dynamic: false, antialiased: true }).unwrap();
            let GaussianFile { gaussians: static_copy, remarks, antialiased } = from_bytes("t", &bytes, &Limits::default()).unwrap();
            assert_eq!(static_copy, HostGaussians { dynamic_scores: vec![0.0; 2], ..gaussians });
            assert!(antialiased && remarks[0].contains("dynamic"));
        }
    }

    #[test]
    fn the_layout_is_the_published_one() {
        let bytes = to_bytes(&sample(3), true).unwrap();
        let text = String::from_utf8_lossy(&bytes);
        assert!(text.starts_with("ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n"));
        assert_eq!(text.matches("property float").count(), 63);
        let body = bytes.len() - 2 * 252;
        let float = |i: usize| f32::from_le_bytes(bytes[body + 4 * i..body + 4 * i + 4].try_into().unwrap());
        // f_rest_1 is the second coefficient of red; f_rest_15 the first of green. Stored rows are coefficient-major: [k][channel].
        assert_eq!(float(9 + 1), 5000.5 + 3.0);
        assert_eq!(float(9 + 15), 5000.5 + 1.0);
    }

    #[test]
    fn order_normals_and_foreign_properties_do_not_matter() {
        let gaussians = sample(0);
        let names = [
            "rot_3",
            "rot_2",
            "rot_1",
            "rot_0",
            "flags",
            "scale_2",
            "scale_1",
            "scale_0",
            "opacity",
            "f_dc_2",
            "f_dc_1",
            "f_dc_0",
            "z",
            "y",
            "x",
            "embedding_0",
        ];
        let mut bytes = b"ply\r\nformat binary_little_endian 1.0\r\ncomment hello\r\nelement vertex 2\r\n".to_vec();
        for name in names {
            bytes.extend(format!("property {} {name}\r\n", if name == "flags" { "uchar" } else { "float" }).bytes());
        }
        bytes.extend(b"end_header\r\n");
        for i in 0..2 {
            let all: Vec<f32> = [
                &gaussians.means[3 * i..3 * i + 3],
                &gaussians.sh_dc[3 * i..3 * i + 3],
                &gaussians.opacity_logits[i..i + 1],
                &gaussians.log_scales[3 * i..3 * i + 3],
            ]
            .concat();
            gaussians.quaternions[4 * i..4 * i + 4].iter().rev().for_each(|v| bytes.extend(v.to_le_bytes()));
            bytes.push(7);
            all.iter().rev().for_each(|v| bytes.extend(v.to_le_bytes()));
            bytes.extend(1.0f32.to_le_bytes());
        }
        let GaussianFile { gaussians: read, remarks, .. } = from_bytes("t", &bytes, &Limits::default()).unwrap();
        assert_eq!(read, HostGaussians { dynamic_scores: vec![0.0; 2], ..gaussians });
        assert!(remarks[1].contains("flags, embedding_0"), "{remarks:?}");
    }
}
