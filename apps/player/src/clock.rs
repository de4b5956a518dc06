//! Time of playback.

/// A clock over a sequence: plays, loops, seeks, steps. Time is normalised, 0 for the first frame and 1 for the last.
#[derive(Clone, Debug, PartialEq)]
pub struct Clock {
    /// Normalised time, 0..1.
    pub time: f32,
    /// Whether it runs.
    pub playing: bool,
    /// Multiple of the recorded speed; negative runs backwards.
    pub speed: f32,
    /// Whether it starts again at the end; else it stops there.
    pub looping: bool,
    /// Seconds from time 0 to 1.
    pub seconds: f32,
    /// Frames of the sequence.
    pub frames: usize,
}

impl Clock {
    /// A clock at the start of a sequence of `frames` frames that lasts `seconds`.
    pub fn new(frames: usize, seconds: f32) -> Self {
        Self { time: 0.0, playing: false, speed: 1.0, looping: true, seconds: seconds.max(1e-3), frames: frames.max(1) }
    }
    /// A clock at the start of another sequence, of `frames` frames that last `seconds`: it stands still, at the speed of this one, and loops where this one
    /// does.
    pub fn of_other(&self, frames: usize, seconds: f32) -> Self {
        Self { speed: self.speed, looping: self.looping, ..Self::new(frames, seconds) }
    }
    /// Moves on by `elapsed_s` seconds of the real clock; whether time changed.
    pub fn tick(&mut self, elapsed_s: f32) -> bool {
        if !self.playing || self.frames < 2 || elapsed_s.is_nan() || elapsed_s <= 0.0 {
            return false;
        }
        let before = self.time;
        let next = before + elapsed_s * self.speed / self.seconds;
        if (0.0..=1.0).contains(&next) {
            self.time = next;
        } else if self.looping {
            self.seek(next.rem_euclid(1.0));
        } else {
            self.seek(next);
            self.playing = false;
        }
        self.time != before
    }
    /// Whether ticks move time, so that further frames are worth drawing.
    pub fn runs(&self) -> bool {
        self.playing && self.frames > 1 && self.speed != 0.0
    }
    /// Plays or pauses. Where time stands at the end, playing begins anew.
    pub fn play(&mut self, on: bool) {
        self.playing = on && self.frames > 1;
        if self.playing && !self.looping {
            let (start, end) = if self.speed < 0.0 { (1.0, 0.0) } else { (0.0, 1.0) };
            if self.time == end {
                self.time = start;
            }
        }
    }
    /// Goes to a normalised time; what is no number is the start.
    pub fn seek(&mut self, time_norm: f32) {
        self.time = if time_norm.is_nan() { 0.0 } else { time_norm.clamp(0.0, 1.0) };
    }
    /// Goes to the nearest frame and `frames` on, and stops. Where there is one frame only, time stays.
    pub fn step(&mut self, frames: i32) {
        self.playing = false;
        if self.frames < 2 {
            return;
        }
        let last = (self.frames - 1) as f32;
        self.seek(((self.time * last).round() + frames as f32) / last);
    }
    /// Index of the nearest frame.
    pub fn frame(&self) -> usize {
        (self.time * (self.frames.saturating_sub(1)) as f32).round() as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_plays_loops_stops_and_steps() {
        let mut clock = Clock::new(11, 2.0);
        assert!(!clock.tick(1.0));
        clock.playing = true;
        assert!(clock.tick(1.0) && (clock.time - 0.5).abs() < 1e-6 && clock.frame() == 5);
        clock.tick(1.5);
        assert!((clock.time - 0.25).abs() < 1e-6);
        (clock.looping, clock.speed) = (false, 10.0);
        clock.tick(1.0);
        assert_eq!((clock.time, clock.playing), (1.0, false));
        clock.play(true);
        assert_eq!((clock.time, clock.playing), (0.0, true));
        clock.play(false);
        clock.seek(0.34);
        clock.step(-1);
        assert!((clock.time - 0.2).abs() < 1e-6);
        clock.step(-5);
        assert_eq!(clock.time, 0.0);
        clock.seek(f32::NAN);
        assert_eq!(clock.time, 0.0);
        (clock.speed, clock.looping, clock.playing) = (0.0, true, true);
        clock.seek(0.5);
        assert!(!clock.tick(0.1) && !clock.runs() && clock.playing && clock.time == 0.5, "at speed 0 nothing has to be drawn again");
        clock.speed = f32::MAX;
        clock.seconds = 1e-3;
        clock.tick(1.0);
        assert!((0.0..=1.0).contains(&clock.time), "{}", clock.time);
        (clock.speed, clock.looping) = (-0.5, false);
        assert_eq!(
            clock.of_other(31, 4.0),
            Clock { speed: -0.5, looping: false, ..Clock::new(31, 4.0) },
            "another sequence plays at the speed that was chosen"
        );
        let mut still = Clock::new(1, 2.0);
        still.step(1);
        assert_eq!((still.time, still.frame()), (0.0, 0), "a single frame has no next one");
    }
}
