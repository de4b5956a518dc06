//! The words of a step in a plan: written by the host from named fields, read by the kernel at named indices.

/// Stands for "none".
pub const NONE: u32 = u32::MAX;
/// Stands for the output buffer where a tile is named.
pub const OUTSIDE: usize = 3;
/// Kinds of steps.
pub const MULTIPLY: u32 = 0;
pub const LOAD: u32 = 1;
pub const SAVE: u32 = 2;
pub const MASK: u32 = 3;
pub const NORM: u32 = 4;
pub const NORM_BACK: u32 = 5;
pub const RELOAD: u32 = 6;

/// Words per step in a plan; a kind leaves the words it does not need at 0.
pub const FIELDS: usize = 14;
pub const KIND: usize = 0;
pub const TILE: usize = 1;
pub const WIDTH: usize = 2;
pub const AT: usize = 3;
pub const WEIGHTS: usize = 4;
pub const TARGET: usize = 5;
pub const OUTPUT: usize = 6;
pub const BIAS: usize = 7;
pub const FLAGS: usize = 8;
pub const COLUMN: usize = 9;
pub const STRIDE: usize = 10;
pub const NORMAL: usize = 11;
pub const SCALE: usize = 12;
pub const BEFORE: usize = 13;

/// Flags of a multiplication.
pub const RELU: u32 = 1;
pub const ACCUMULATE: u32 = 2;

/// The words of a step by name.
#[derive(Default)]
pub struct Fields {
    /// What is done.
    pub kind: u32,
    /// The tile it is done to; of a multiplication, the one it reads.
    pub tile: usize,
    /// Columns of that tile.
    pub width: usize,
    /// Where rows start in the output buffer; for a load, in the given one; for a derivative of a norm, where the gradient of its input goes.
    pub at: usize,
    /// Where the matrix, or the gain, starts among the weights.
    pub weights: usize,
    /// The tile a multiplication writes, or [`OUTSIDE`].
    pub target: usize,
    /// Columns a multiplication writes.
    pub output: usize,
    /// Where the bias starts among the weights, or [`NONE`].
    pub bias: usize,
    /// Whether a multiplication ends in a ReLU.
    pub relu: bool,
    /// Whether a multiplication adds to its target.
    pub add: bool,
    /// First column of a load.
    pub column: usize,
    /// Values per given row of a load.
    pub stride: usize,
    /// Where normalised values are saved, or [`NONE`].
    pub normal: usize,
    /// Where scales are saved.
    pub scale: usize,
    /// Where the gradient of the value before Mish is saved.
    pub before: usize,
}

impl Fields {
    /// The words in their order.
    pub fn encode(&self) -> [u32; FIELDS] {
        let mut words = [0; FIELDS];
        words[KIND] = self.kind;
        words[TILE] = self.tile as u32;
        words[WIDTH] = self.width as u32;
        words[AT] = self.at as u32;
        words[WEIGHTS] = self.weights as u32;
        words[TARGET] = self.target as u32;
        words[OUTPUT] = self.output as u32;
        words[BIAS] = self.bias as u32;
        words[FLAGS] = if self.relu { RELU } else { 0 } | if self.add { ACCUMULATE } else { 0 };
        words[COLUMN] = self.column as u32;
        words[STRIDE] = self.stride as u32;
        words[NORMAL] = self.normal as u32;
        words[SCALE] = self.scale as u32;
        words[BEFORE] = self.before as u32;
        words
    }
}
