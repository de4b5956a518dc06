//! cc4dgs-deformers
