//! The command as a process.
#![allow(dead_code, reason = "each test program uses some of these")]

use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output, Stdio};

/// The command, which reads nothing.
pub fn cc4dgs() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cc4dgs"));
    command.stdin(Stdio::null());
    command
}

pub fn run(args: &[&str]) -> Output {
    cc4dgs().args(args).output().expect("the program starts")
}

/// What a process wrote to standard error.
pub fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub fn succeed(args: &[&str]) -> Output {
    let output = run(args);
    assert!(output.status.success(), "{args:?}: {}", said(&output));
    output
}

/// The JSON that a command with `--json` in `args` writes.
pub fn json_of(args: &[&str]) -> Value {
    serde_json::from_slice(&succeed(args).stdout).expect("standard output is JSON")
}

/// Runs a command that must fail with `code`; returns what it said.
pub fn fail(args: &[&str], code: i32) -> String {
    let output = run(args);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {}", said(&output));
    assert!(said(&output).contains("error"), "{args:?}: {}", said(&output));
    said(&output)
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

pub fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// The smallest scene and the shortest training that goes through every stage.
pub fn train_args<'a>(out: &'a str, iterations: &'a str) -> Vec<&'a str> {
    vec![
        "train",
        "--scene",
        "procedural:tiny",
        "--preset",
        "demo",
        "--set",
        iterations,
        "--set",
        "train.checkpoint_every=0",
        "--device",
        "flex",
        "--out",
        out,
        "-q",
    ]
}
