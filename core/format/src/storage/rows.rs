//! Rows of an attribute as columns of codes, and back.

use super::column::{self, Column, Form};
use crate::Result;
use crate::archive::ByteReader;

/// Appends the forms of `columns` to `meta` and their outliers to `escapes`, and returns their codes, one column after the other.
pub fn store(columns: &[Column], meta: &mut Vec<u8>, escapes: &mut Vec<u8>) -> Vec<u8> {
    for column in columns {
        column.form.write(meta);
        column::write_escapes(&column.escapes, escapes);
    }
    columns.iter().flat_map(|c| &c.codes).copied().collect()
}

/// Undoes [`store`]: `width` columns of `count` values. `codes` must end there.
pub fn load(mut codes: ByteReader, count: usize, width: usize, meta: &mut ByteReader, escapes: &mut ByteReader) -> Result<Vec<Vec<f32>>> {
    let mut columns = Vec::with_capacity(width);
    for _ in 0..width {
        let form = Form::read(meta)?;
        columns.push(column::read(&mut codes, form, count, &column::read_escapes(escapes)?)?);
    }
    codes.finish()?;
    Ok(columns)
}

/// Passes over `width` columns of [`store`] whose codes are not there. Rows of zeros `[count,width]` stand in for them.
pub fn skip(count: usize, width: usize, meta: &mut ByteReader, escapes: &mut ByteReader) -> Result<Vec<f32>> {
    for _ in 0..width {
        Form::read(meta)?;
        column::read_escapes(escapes)?;
    }
    Ok(vec![0.0; count * width])
}

/// The columns of `rows` `[N,width]`.
pub fn split(rows: &[f32], width: usize) -> Vec<Vec<f32>> {
    (0..width).map(|c| rows.iter().skip(c).step_by(width).copied().collect()).collect()
}

/// Rows `[N,columns]` of `columns`, each of `count` values.
pub fn interleave(columns: &[Vec<f32>], count: usize) -> Vec<f32> {
    let mut rows = Vec::with_capacity(count * columns.len());
    for i in 0..count {
        rows.extend(columns.iter().map(|c| c[i]));
    }
    rows
}
