//! Building blocks that most codecs share.
//!
//! * [`Shape`], [`StreamSet`], [`open`], [`assemble`], [`close`]: the common structure of codecs. A `meta` stream holds a version, the number of Gaussians, the
//!   degree and the extra attributes; a decoder reads and checks them before it allocates memory.
//! * [`extra_streams`], [`Shape::read_extra`]: the extra attributes of plug-ins, bit for bit or within their tolerance, in the rows that are needed.
//! * [`mod@column`], [`store`], [`load`], [`split`], [`interleave`], [`skip`]: columns of codes with few bits, outliers stored exactly in a separate list.
//! * [`to_planes`], [`from_planes`]: float32 values, column by column.
//! * [`relative_rms`], [`column_loss`], [`ColumnLoss`], [`PartialLoss`]: what rounding loses.
//! * [`write_shapes`], [`read_shapes`]: names and shapes of a deformer's weights.
//!
//! The smallest lossless codec:
//!
//! ```
//! use cc4dgs_format::storage::{Attributes, META, Shape, extra_streams, from_planes, open, to_planes};
//! use cc4dgs_format::{CodecContext, HostGaussians, Result, Stream};
//!
//! fn encode(gaussians: &HostGaussians) -> Result<Vec<Stream>> {
//!     let mut meta = vec![1];
//!     Shape::of(gaussians).write(&mut meta)?;
//!     let mut streams = vec![Stream { name: META.into(), bytes: meta }];
//!     streams.extend(gaussians.columns().map(|(name, width, values)| Stream { name: name.into(), bytes: to_planes(values, width) }));
//!     streams.extend(extra_streams(gaussians, Attributes::Exact));
//!     Ok(streams)
//! }
//!
//! fn decode(streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
//!     let (set, meta, shape) = open("mine", streams, 1, &context.limits)?;
//!     meta.finish()?;
//!     let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
//!     for (name, width, values) in out.columns_mut() {
//!         *values = from_planes(set.reader(name)?, shape.count, width)?;
//!     }
//!     shape.read_extra(&set, &mut out)?;
//!     out.validate_read("decoded Gaussians", &context.limits)?;
//!     Ok(out)
//! }
//! ```

pub mod column;
mod extra;
mod loss;
pub mod mulaw;
mod rows;
mod shapes;
mod streams;

pub use extra::{Attributes, extra_streams};
pub use loss::{ColumnLoss, PartialLoss, central_loss, column_loss, relative_rms};
pub use rows::{interleave, load, skip, split, store};
pub use shapes::{read_shapes, value_count, write_shapes};
pub use streams::{ESCAPES, HARMONICS, META, Shape, StreamSet, assemble, close, from_planes, open, stage_of_column, to_planes};
