//! Lives of Gaussians as trainer and deformers share them: the attributes that hold a velocity and the time at which a Gaussian is there.

/// Names of the attributes, in order, and their widths: the centre T of a life and the logarithms of its half-width r and of its falloff s, as shares of the
/// sequence; its gate; and the velocity in world units per sequence.
pub const LIFE_ATTRIBUTES: [(&str, usize); 5] = [("life_center", 1), ("life_log_half_width", 1), ("life_log_falloff", 1), ("life_gate", 1), ("velocity", 3)];
/// Names of the attributes of a Gaussian of space and time, in order, and their widths: its centre in time and the logarithm of its standard deviation there,
/// as shares of the sequence, and its velocity in world units per sequence. Its canonical centre is the one at its centre in time. Where Gaussians carry all
/// three, density controls that split Gaussians at random points of themselves may do so in time, too.
pub const SPACE_TIME_ATTRIBUTES: [(&str, usize); 3] = [("time_center", 1), ("log_duration", 1), ("velocity", 3)];
/// Slope of the gate: it is the sigmoid of this factor times its attribute (FreeTimeGS++).
pub const LIFE_GATE_STEEPNESS: f32 = 20.0;

/// The value of the attribute `life_gate` for a gate `gate` in 0..1. It is finite for 0, which becomes a gate of 2e-9, and for 1, which is 1 again in
/// float32: such a Gaussian is visible at all times, and its life has no gradient.
pub fn gate_value(gate: f32) -> f32 {
    ((gate / (1.0 - gate)).ln() / LIFE_GATE_STEEPNESS).clamp(-1.0, 1.0)
}
