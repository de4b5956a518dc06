//! The time and the pose that a window begins at, as the options of a command.

use crate::navigator::pose::{POSE_ASPECT, POSE_FOV};
use crate::{Navigator, Pose};
use cc4dgs_format::{Error, Result};
use std::path::Path;

/// Where a window begins; what is absent is as the model says: the first frame, the home camera, playing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Start {
    /// Normalised time, 0..1, at which it stands still.
    pub time: Option<f32>,
    /// A pose of [`Navigator::pose_shown`].
    pub pose: Option<Pose>,
}

impl Start {
    /// Reads a pose as links of the page have it: seven numbers with commas between, or nine with roll and aspect.
    ///
    /// # Errors
    /// [`Error::Parameter`] for text that is none, and for poses that see nothing.
    pub fn parse_pose(text: &str) -> Result<Pose> {
        let remedy = "Write EYE_X,EYE_Y,EYE_Z,TARGET_X,TARGET_Y,TARGET_Z,FOV_Y[,ROLL[,ASPECT]] with angles in radians, as a shared link has it";
        let wrong = |problem: String| Error::parameter("pose", problem, remedy);
        let numbers: Vec<f64> = text.split(',').map(|v| v.trim().parse().map_err(|_| wrong(format!("{v:?} is no number")))).collect::<Result<_>>()?;
        let pose = Navigator::pose_of(&numbers).ok_or_else(|| wrong(format!("it has {} numbers, not 7 to 9", numbers.len())))?;
        let sees = Navigator::new(&Default::default(), [-1.0; 3], [1.0; 3]).set_pose(pose);
        let angles = format!("the angle is not from {:e} to {}", POSE_FOV.start(), POSE_FOV.end());
        let aspects = format!("the aspect is not from {:e} to {:e}", POSE_ASPECT.start(), POSE_ASPECT.end());
        if sees { Ok(pose) } else { Err(wrong(format!("a number is not finite, eye and target are one point, {angles}, or {aspects}"))) }
    }
    /// Reads a normalised time.
    ///
    /// # Errors
    /// [`Error::Parameter`] for what is no number from 0 to 1.
    pub fn parse_time(text: &str) -> Result<f32> {
        let time = text.parse().ok().filter(|t| (0.0..=1.0).contains(t));
        time.ok_or_else(|| Error::parameter("time", format!("{text:?} is no number from 0 to 1"), "0 is the first frame, 1 the last"))
    }
    /// The command that opens `file` here with `program`, for a POSIX shell.
    pub fn command(&self, program: &str, file: &Path) -> String {
        let mut out = format!("{program} {}", quoted(&file.to_string_lossy()));
        if let Some(time) = self.time {
            out += &format!(" --time {time}");
        }
        if let Some(pose) = self.pose {
            out += &format!(" --pose={}", Navigator::pose_text(pose));
        }
        out
    }
}

/// Why a window that shows a training does not open `file`, and what does.
pub(crate) fn busy_with_training(file: &Path) -> String {
    format!("This window shows a training, and opens no file. Another window does: {}", Start::default().command("cc4dgs view", file))
}

fn quoted(text: &str) -> String {
    let plain = !text.is_empty() && !text.starts_with('-') && text.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c));
    if plain { text.to_string() } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_says_where_it_begins() {
        let pose = [500_001.0, 5_200_000.0 - 2.5, 1.0 / 3.0, 5e5, 5.2e6, 1e-7, 0.9];
        let start = Start { time: Some(0.37), pose: Navigator::pose_of(&pose) };
        let command = start.command("cc4dgs view", Path::new("it's here/a.cc4d"));
        assert_eq!(command, r"cc4dgs view 'it'\''s here/a.cc4d' --time 0.37 --pose=500001,5199997.5,0.333333,500000,5200000,0,0.9");
        let read = Start::parse_pose(command.split_once("--pose=").unwrap().1).unwrap();
        assert!(read.iter().zip(pose).all(|(a, b)| (a - b).abs() < 1e-6), "{read:?}");
        assert_eq!(Start::parse_pose("3,0,0,0,0,0,0.9,-0.25").unwrap(), [3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.9, -0.25, 0.0]);
        let wide = Start { time: None, pose: Some(Start::parse_pose("3,0,0,0,0,0,0.9,0,1.6").unwrap()) };
        assert_eq!(wide.command("cc4dgs view", Path::new("a.cc4d")), "cc4dgs view a.cc4d --pose=3,0,0,0,0,0,0.9,0,1.6");
        assert_eq!(Start::default().command("cc4dgs view", Path::new("runs/mutant")), "cc4dgs view runs/mutant");
    }

    #[test]
    fn a_window_of_a_training_names_the_command_that_opens_a_file() {
        let said = busy_with_training(Path::new("my runs/a.cc4d"));
        assert!(said.contains("shows a training") && said.ends_with("cc4dgs view 'my runs/a.cc4d'"), "{said}");
    }

    #[test]
    fn poses_and_times_that_mean_nothing_are_refused() {
        let (point, angle) = ("one point", "from 1e-9 to 3.1");
        let wrong = [
            ("1,2,3", "3 numbers"),
            ("a,0,0,0,0,0,1", "\"a\""),
            ("1,1,1,1,1,1,0.9", point),
            ("0,0,0,1,0,0,9", angle),
            ("NaN,0,0,1,0,0,1", point),
            ("0,0,0,1,0,0,1,0,-2", "the aspect is not from 1e-10 to 1e10"),
        ];
        for (text, said) in wrong {
            let message = Start::parse_pose(text).unwrap_err().to_string();
            assert!(message.contains(said), "{text}: {message}");
        }
        assert_eq!(Start::parse_time("0.5").unwrap(), 0.5);
        assert!(Start::parse_time("1.5").is_err() && Start::parse_time("NaN").is_err() && Start::parse_time("now").is_err());
    }
}
