//! Points with colours from the PLY files that structure from motion writes: text or binary, numbers of any type. Counts are held against limits, and against
//! the bytes that are there before anything is allocated for them.

use cc4dgs_core::{Error, Limits, RawPoints, Result};

/// Largest header in bytes.
const HEADER_LIMIT: usize = 64 << 10;
/// The colour of points without one.
const GREY: f32 = 0.5;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
    Text,
    LittleEndian,
    BigEndian,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    /// By its name in a header.
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }
    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
    /// The value of a colour's full intensity.
    fn full_intensity(self) -> f64 {
        match self {
            Self::F32 | Self::F64 => 1.0,
            Self::U16 => 65535.0,
            _ => 255.0,
        }
    }
    /// The number of the first bytes of `from`, which has as many as it takes.
    fn read(self, from: &[u8], encoding: Encoding) -> f64 {
        let mut b = [0; 8];
        let used = &mut b[..self.bytes()];
        used.copy_from_slice(&from[..self.bytes()]);
        if encoding == Encoding::BigEndian {
            used.reverse();
        }
        match self {
            Self::I8 => f64::from(i8::from_le_bytes([b[0]])),
            Self::U8 => f64::from(b[0]),
            Self::I16 => f64::from(i16::from_le_bytes([b[0], b[1]])),
            Self::U16 => f64::from(u16::from_le_bytes([b[0], b[1]])),
            Self::I32 => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::U32 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F32 => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F64 => f64::from_le_bytes(b),
        }
    }
}

fn damaged(object: &str, problem: String) -> Error {
    Error::data(object, problem, "The file is damaged or no PLY of points; write it again")
}

/// Text of a file for an error, in one line and not too long.
fn shown(text: &str) -> String {
    text.escape_default().take(80).collect()
}

/// What the header says of the vertices, which come first.
struct Header {
    encoding: Encoding,
    count: u64,
    /// Names and types in the order of the file.
    properties: Vec<(String, Number)>,
    /// Bytes of the header itself.
    length: usize,
}

impl Header {
    fn parse(object: &str, bytes: &[u8], limits: &Limits) -> Result<Self> {
        let bad = |problem: String| damaged(object, problem);
        let (mut encoding, mut count, mut properties, mut length) = (None, None, Vec::new(), 0);
        // Whether the next properties are those of vertices.
        let mut of_vertex = false;
        loop {
            let head = &bytes[length..bytes.len().min(HEADER_LIMIT)];
            let Some(end) = head.iter().position(|&b| b == b'\n') else {
                return Err(bad(format!("the header does not end within {} bytes", bytes.len().min(HEADER_LIMIT))));
            };
            let line = String::from_utf8_lossy(&head[..end]);
            let first = length == 0;
            length += end + 1;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words.as_slice() {
                ["ply"] if first => {}
                _ if first => return Err(bad("the first line is not 'ply'".into())),
                [] | ["comment" | "obj_info", ..] => {}
                ["format", "ascii", ..] => encoding = Some(Encoding::Text),
                ["format", "binary_little_endian", ..] => encoding = Some(Encoding::LittleEndian),
                ["format", "binary_big_endian", ..] => encoding = Some(Encoding::BigEndian),
                ["element", "vertex", stated] if count.is_none() => {
                    let stated: u64 = stated.parse().map_err(|_| bad(format!("'{}' is not a number of vertices", shown(stated))))?;
                    limits.check_gaussians(object, stated)?;
                    (count, of_vertex) = (Some(stated), true);
                }
                ["element", name, _] if count.is_none() => {
                    return Err(Error::unsupported(object, format!("element '{}' comes before the vertices", shown(name)), "Write a PLY of points alone"));
                }
                ["element", _, _] => of_vertex = false,
                ["property", "list", ..] if of_vertex => return Err(bad("its vertices have lists".into())),
                ["property", kind, name] if of_vertex => {
                    let number = Number::from_name(kind).ok_or_else(|| bad(format!("property '{}' has the unknown type '{}'", shown(name), shown(kind))))?;
                    properties.push(((*name).to_string(), number));
                }
                ["property", ..] if count.is_some() => {}
                ["end_header"] => {
                    let (Some(encoding), Some(count)) = (encoding, count) else {
                        return Err(bad("the header has no format or no element vertex".into()));
                    };
                    return Ok(Self { encoding, count, properties, length });
                }
                _ => return Err(bad(format!("the header line '{}' is not understood", shown(&line)))),
            }
        }
    }
    /// Indices of the properties `names`, if all are there.
    fn columns(&self, names: [&str; 3]) -> Option<[usize; 3]> {
        let of = |name: &str| self.properties.iter().position(|(own, _)| own == name);
        Some([of(names[0])?, of(names[1])?, of(names[2])?])
    }
    /// Calls `each` with the values of every vertex.
    fn vertices(&self, object: &str, body: &[u8], mut each: impl FnMut(&[f64]) -> Result<()>) -> Result<()> {
        let mut values = vec![0.0; self.properties.len()];
        if self.encoding == Encoding::Text {
            let text = std::str::from_utf8(body).map_err(|e| damaged(object, format!("byte {} is not text", self.length + e.valid_up_to())))?;
            let mut words = text.split_ascii_whitespace();
            for vertex in 0..self.count {
                for (value, (name, _)) in values.iter_mut().zip(&self.properties) {
                    let word = words.next().ok_or_else(|| damaged(object, format!("it states {} vertices and ends in vertex {vertex}", self.count)))?;
                    *value =
                        word.parse::<f64>().map_err(|_| damaged(object, format!("vertex {vertex}: {} is '{}', not a number", shown(name), shown(word))))?;
                }
                each(&values)?;
            }
            return Ok(());
        }
        let stride: usize = self.properties.iter().map(|(_, number)| number.bytes()).sum();
        let claimed = self.count.saturating_mul(stride as u64);
        if claimed > body.len() as u64 {
            return Err(damaged(object, format!("{} vertices of {stride} bytes need {claimed} bytes, {} follow the header", self.count, body.len())));
        }
        for vertex in body[..claimed as usize].chunks_exact(stride) {
            let mut rest = vertex;
            for (value, (_, number)) in values.iter_mut().zip(&self.properties) {
                *value = number.read(rest, self.encoding);
                rest = &rest[number.bytes()..];
            }
            each(&values)?;
        }
        Ok(())
    }
}

/// The vertices of the PLY `bytes`, one or more, with their colours; grey where it has none. `object` names the file in errors.
pub(crate) fn points(object: &str, bytes: &[u8], limits: &Limits) -> Result<RawPoints> {
    let cloud = points_or_none(object, bytes, limits)?;
    if cloud.positions.is_empty() {
        return Err(damaged(object, "it has no vertices".into()));
    }
    Ok(cloud)
}

/// As [`points`], for a file that may have no vertices.
pub(crate) fn points_or_none(object: &str, bytes: &[u8], limits: &Limits) -> Result<RawPoints> {
    let header = Header::parse(object, bytes, limits)?;
    let xyz = header.columns(["x", "y", "z"]).ok_or_else(|| damaged(object, "its vertices lack x, y or z".into()))?;
    let colour = header.columns(["red", "green", "blue"]);
    let mut cloud = RawPoints::default();
    header.vertices(object, &bytes[header.length..], |values| {
        let position = xyz.map(|column| values[column]);
        if position.iter().any(|v| !(*v as f32).is_finite()) {
            return Err(damaged(object, format!("vertex {} is at {position:?}", cloud.positions.len())));
        }
        let intensity = |column: usize| {
            let share = values[column] / header.properties[column].1.full_intensity();
            if share.is_finite() { share.clamp(0.0, 1.0) as f32 } else { GREY }
        };
        cloud.positions.push(position);
        cloud.colors.push(colour.map_or([GREY; 3], |columns| columns.map(intensity)));
        Ok(())
    })?;
    Ok(cloud)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<RawPoints> {
        points("t.ply", bytes, &Limits::default())
    }

    /// A header with the properties `types`, from x on.
    fn header(format: &str, count: u64, types: &[(&str, &str)]) -> String {
        let properties: String = types.iter().map(|(kind, name)| format!("property {kind} {name}\n")).collect();
        format!("ply\nformat {format} 1.0\ncomment t\nelement vertex {count}\n{properties}element face 0\nproperty list uchar int vertex_indices\nend_header\n")
    }

    const COLOURED: [(&str, &str); 6] = [("float", "x"), ("float", "y"), ("float", "z"), ("uint8", "red"), ("uint8", "green"), ("uint8", "blue")];
    const DOUBLE: [(&str, &str); 4] = [("uchar", "quality"), ("double", "z"), ("double", "y"), ("double", "x")];

    #[test]
    fn text_and_binary_files_give_the_same_points() {
        let wanted = RawPoints { positions: vec![[0.5, -1.0, 2.0], [3.0, 4.0, 5.0]], colors: vec![[1.0, 0.0, 0.2], [0.0, 1.0, 1.0]] };
        let text = header("ascii", 2, &COLOURED) + "0.500000 -1.000000 2 255 0 51\n3 4 5e0 0 255 255\n";
        assert_eq!(read(text.as_bytes()).unwrap(), wanted);
        assert_eq!(read(text.replace('\n', "\r\n").as_bytes()).unwrap(), wanted);
        for big in [false, true] {
            let mut bytes = header(if big { "binary_big_endian" } else { "binary_little_endian" }, 2, &COLOURED).into_bytes();
            for (position, color) in [([0.5f32, -1.0, 2.0], [255u8, 0, 51]), ([3.0, 4.0, 5.0], [0, 255, 255])] {
                position.iter().for_each(|v| bytes.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() }));
                bytes.extend(color);
            }
            assert_eq!(read(&bytes).unwrap(), wanted);
        }
    }

    #[test]
    fn points_without_colours_are_grey() {
        let mut bytes = header("binary_little_endian", 1, &DOUBLE).into_bytes();
        bytes.push(9);
        [3.0f64, 2.0, 1.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        assert_eq!(read(&bytes).unwrap(), RawPoints { positions: vec![[1.0, 2.0, 3.0]], colors: vec![[GREY; 3]] });
    }

    #[test]
    fn damaged_files_and_claims_are_refused() {
        let sound = header("ascii", 1, &COLOURED) + "1 2 3 4 5 6\n";
        let with = |from: &str, to: &str| sound.replace(from, to).into_bytes();
        for (bytes, problem) in [
            (Vec::new(), "does not end"),
            (with("ply\n", "plx\n"), "'ply'"),
            (with("ascii", "utf16"), "not understood"),
            (with("vertex 1", "vertex -1"), "number of vertices"),
            (with("vertex 1", "vertex 2"), "ends in vertex 1"),
            (with("vertex 1", "vertex 0"), "no vertices"),
            (with("float x", "float w"), "x, y or z"),
            (with("float x", "half x"), "unknown type 'half'"),
            (with("float x", "list uchar int x"), "lists"),
            (with("element vertex", "element edge"), "before the vertices"),
            (with("1 2 3", "1 2 nan"), "NaN"),
            (with("1 2 3", "1 2 up"), "'up', not a number"),
            (with("ascii", "binary_little_endian"), "need 15 bytes"),
        ] {
            let message = read(&bytes).unwrap_err().to_string();
            assert!(message.starts_with("t.ply: ") && message.contains(problem), "{message}");
        }
        for count in ["20000001", "18446744073709551615"] {
            let error = read(&with("vertex 1", &format!("vertex {count}"))).unwrap_err();
            assert!(matches!(error, Error::Limit { .. }), "{error}");
        }
        (0..sound.len() - 2).for_each(|end| assert!(read(&sound.as_bytes()[..end]).is_err(), "cut at {end}"));
    }
}
