//! cc4dgs-codecs
