//! Readers of numbers that several commands take.

/// Most threads of a process: more would take the memory of their stacks and no work.
const MOST_THREADS: usize = 1024;

/// Reads a number of minutes, which is above 0 and finite.
pub fn parse_minutes(text: &str) -> Result<f64, String> {
    let minutes = text.parse::<f64>().ok().filter(|minutes| *minutes > 0.0 && minutes.is_finite());
    minutes.ok_or_else(|| "write a number of minutes above 0, such as 10".into())
}

/// Reads a number of threads, where 0 stands for all cores.
pub fn parse_threads(text: &str) -> Result<usize, String> {
    let threads = text.parse::<usize>().ok().filter(|threads| *threads <= MOST_THREADS);
    threads.ok_or_else(|| format!("write a whole number from 0 (all cores) to {MOST_THREADS}"))
}

#[cfg(test)]
mod tests {
    use crate::args::{Cli, Command};
    use clap::Parser;

    #[test]
    fn minutes_and_threads_out_of_range_name_their_option() {
        let read = |line: &str| Cli::try_parse_from(line.split(' ')).map_err(|error| error.to_string());
        let train = "cc4dgs train --scene a --out b --minutes";
        for line in [format!("{train} 0.5"), format!("{train} 1e3"), "cc4dgs plugins --threads 1024".into(), "cc4dgs --threads 0 plugins".into()] {
            read(&line).unwrap();
        }
        for minutes in ["0", "-1", "NaN", "inf", "ten"] {
            for line in [format!("{train} {minutes}"), format!("cc4dgs sweep plan g.toml --minutes {minutes}")] {
                let message = read(&line).unwrap_err();
                assert!(["--minutes", minutes, "above 0"].iter().all(|part| message.contains(part)), "{message}");
            }
        }
        for threads in ["1025", "two"] {
            let message = read(&format!("cc4dgs plugins --threads {threads}")).unwrap_err();
            assert!(["--threads", threads, "1024"].iter().all(|part| message.contains(part)), "{message}");
        }
    }

    #[test]
    fn an_orbit_may_turn_the_other_way() {
        let cli = Cli::try_parse_from("cc4dgs render a --out b --turns -0.5".split(' ')).unwrap();
        let Command::Render(args) = &cli.command else { panic!("{:?}", cli.command) };
        assert_eq!(args.shots.turns(), -0.5);
        // A time below 0 is a value, which the command refuses with its range.
        for line in ["cc4dgs decompress a --out b.ply --time -0.1", "cc4dgs export ply a --out b.ply --time -0.1"] {
            Cli::try_parse_from(line.split(' ')).unwrap();
        }
    }
}
