//! Options that are stated and have no effect are refused, by one check for all commands.

use cc4dgs_core::{Error, Result};
use clap::ValueEnum;

/// An option that has no effect on some of what a command does.
pub struct Stated {
    /// Its name, such as `--size`.
    pub option: &'static str,
    /// Its value as it is written; `None` where the option is not stated.
    pub value: Option<String>,
    /// Whether it has an effect on what is asked for.
    pub used: bool,
    /// What to do instead.
    pub remedy: String,
}

/// Refuses the first of the options that are stated and have no effect on `subject`.
pub fn refuse_ignored(subject: &str, options: impl IntoIterator<Item = Stated>) -> Result<()> {
    for Stated { option, value, used, remedy } in options {
        if let (Some(value), false) = (value, used) {
            return Err(Error::parameter(format!("{option} {value}"), format!("it has no effect on {subject}"), remedy));
        }
    }
    Ok(())
}

/// The value of an option as it is written.
pub fn written(value: &impl ValueEnum) -> String {
    value.to_possible_value().map_or_else(String::new, |value| value.get_name().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_stated_and_not_used_is_refused() {
        let of = |value: Option<&str>, used| Stated { option: "--size", value: value.map(Into::into), used, remedy: "Leave it out".into() };
        for accepted in [of(None, false), of(None, true), of(Some("8x6"), true)] {
            refuse_ignored("ply", [accepted]).unwrap();
        }
        let message = refuse_ignored("ply", [of(Some("8x6"), true), of(Some("9x6"), false)]).unwrap_err().to_string();
        assert_eq!(message, "--size 9x6: it has no effect on ply. Leave it out");
    }
}
