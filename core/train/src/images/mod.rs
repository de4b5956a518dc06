//! Images to look at: PNG files, error maps, contact sheets with captions.

mod font;
mod heat;
mod png;
mod sheet;

pub use font::{GLYPH_HEIGHT, GLYPH_WIDTH, draw_text, text_width};
pub use heat::{error_map, heat_color};
pub use png::{encode_png, write_png};
pub use sheet::{Comparison, SheetOptions, comparison_sheet};
