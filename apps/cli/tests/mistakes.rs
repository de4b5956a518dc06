//! Wrong requests and wrong files: exit codes, messages, and what is left on disk.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::{fail, run, succeed, text};
use serde_json::Value;

#[test]
fn mistakes_end_with_their_own_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    let (out, broken) = (folder.path().join("out"), folder.path().join("broken.cc4d"));
    fail(&["trian"], 2);
    fail(&["eval"], 2);
    fail(&["render", "x", "--out", "y", "--size", "0x3"], 2);
    // An orbit has no split and no scene options.
    assert!(fail(&["render", "x", "--out", "y", "--split", "test"], 2).contains("--scene"));
    assert!(fail(&["render", "x", "--out", "y", "--set", "scene.width=8"], 2).contains("--scene"));
    assert!(fail(&["train", "--scene", "procedural", "--preset", "dnref", "--out", text(&out)], 2).contains("dnerf"));
    assert!(fail(&["train", "--scene", "procedural", "--preset", "demo", "--set", "train.iteratons=3", "--out", text(&out)], 2).contains("iteratons"));
    assert!(fail(&["train", "--scene", "procedural", "--preset", "demo", "--device", "fleks", "--out", text(&out)], 2).contains("flex"));
    let unknown = "deformer.capasity=small";
    assert!(fail(&["train", "--scene", "procedural", "--preset", "demo", "--set", unknown, "--out", text(&out)], 2).contains("capasity"));
    fail(&["train", "--scene", text(&folder.path().join("nowhere")), "--out", text(&out)], 2);
    let absent = fail(&["train", "--scene", "procedural:tiny", "--resume", "--out", text(&out)], 2);
    assert!(absent.contains("nothing to resume") && absent.contains("--overwrite"), "{absent}");
    assert!(!out.exists(), "a refused command leaves nothing behind");
    std::fs::write(&broken, b"\x89CC4D\r\n\x1a\x03\0\0\0\x10\0\0\0 and then nothing that makes sense as a header").unwrap();
    fail(&["info", text(&broken)], 3);
    fail(&["eval", text(&broken), "--scene", "procedural:tiny"], 3);
    let missing = fail(&["decompress", text(&folder.path().join("missing.cc4d")), "--out", text(&out)], 2);
    assert!(missing.contains("missing.cc4d: no such file") && missing.contains("the folder of a run"), "{missing}");
    fail(&["--limit", "max_gausians=3", "doctor"], 2);
    // Options without effect and wrong names are noticed before anything is read.
    for (args, part) in [
        ("decompress x --no-dynamic --out y.spz", "name a file that ends in .ply"),
        ("decompress x --out y.glb", "`cc4dgs export gltf`"),
        ("export ply x --frames 3 --out y.ply", "ply-sequence"),
        ("export sog x --fps 3 --out y.sog", "--fps 3: it has no effect on the format sog"),
        ("export splatv x --frames 3 --out y.splatv", "--frames 3: it has no effect on the format splatv"),
        ("export ply-sequence x --fps 3 --out y", "mp4, web"),
        ("export ply x --scene y --out y.ply", "--scene y: it has no effect on the format ply"),
        ("export ply x --set scene.width=8 --out y.ply", "--set scene.width=8: it has no effect on the format ply"),
        ("export web x --set scene.width=8 --out y.html", "scene options without --scene"),
        ("decompress x --time 2 --out y.ply", "not in 0..1"),
        ("render x --fps 3 --out y", "--mp4"),
        ("render x --scene y --up=-x --out z", "--up -x: it has no effect on the cameras of --scene"),
        ("report x --images none --views 3", "--views 3: it has no effect on a page without images"),
        ("sweep run x --no-wait", "--index"),
        ("bench agree x --scene y --devices flex", "--devices flex: one device has nothing to be compared with"),
        ("render x --out y --mp4 z.avi", "Name it z.mp4"),
        ("compress x --out y.cc4d/", "y.cc4d/: it ends with a separator"),
        ("export ply x --out y.ply/", "y.ply/: it ends with a separator"),
        ("plugins cdf --json y/", "y/: it ends with a separator"),
        ("plugins cdf --limit max_bytes", "--limit max_bytes: no '=' found. Write --limit NAME=VALUE"),
        ("train --scene procedural:tiny --device flex --set device=wgpu --out y", "--set device=wgpu: it has no effect on a command with --device"),
        ("demo --limit max_depth=9 --set limits.max_depth=8 --out y", "--set limits.max_depth=8: it has no effect on a command with --limit max_depth=9"),
        ("eval x --scene y --sheet a.png --sheet-rows 0", "--sheet a.png: --sheet-rows 0 draws"),
        ("compress x --codec kwantize --out y.cc4d", "quantize"),
        ("compress x --codec raw --set bitz=3 --out y.cc4d", "bitz"),
        ("compress x --field-weights compact:max-drop=0.01dB --out y.cc4d", "'compact:max-drop=0.01dB': a loss of PSNR"),
        ("compress x --codec compact:max-drop=0.05dB --out y.cc4d", "(--scene), or choose --codec compact:psnr"),
        ("compress x --codec compact --set finetune=9 --out y.cc4d", "(--scene), or leave --set finetune out"),
        // An orbit has no images, and no scene options.
        ("compress x --orbit 16 --field-weights compact:max-drop=0.01dB --out y.cc4d", "'compact:max-drop=0.01dB': a loss of PSNR"),
        ("compress x --orbit 16 --codec compact:max-drop=0.05dB --out y.cc4d", "(--scene), or choose --codec compact:psnr"),
        ("compress x --orbit 16 --codec compact --set finetune=9 --out y.cc4d", "(--scene), or leave --set finetune out"),
        ("compress x --orbit 16 --set scene.width=9 --out y.cc4d", "scene options without --scene"),
        ("compress x --orbit 16 --scene y --out y.cc4d", "cannot be used with"),
        ("compress x --orbit 11 --out y.cc4d", "12 to 512 views"),
        ("compress x --orbit 16 --out y.cc4d", "--orbit 16: it has no effect on the codec cca:default"),
        ("bake x --field-weights compact:max-drop=0.01dB --out y.cc4d", "(--scene), or state the bits"),
    ] {
        let said = fail(&args.split(' ').collect::<Vec<_>>(), 2);
        assert!(said.contains(part), "{args}: {said}");
    }
    // Files that would be replaced are refused as early.
    let kept = folder.path().join("kept.ply");
    std::fs::write(&kept, "mine").unwrap();
    for command in [&["export", "ply"][..], &["decompress"]] {
        let said = fail(&[command, &["no/such/model", "--out", text(&kept)]].concat(), 2);
        assert!(said.contains("kept.ply") && said.contains("--overwrite"), "{said}");
    }
    #[cfg(unix)]
    {
        let name: &std::ffi::OsStr = std::os::unix::ffi::OsStrExt::from_bytes(b"\xff");
        let output = common::cc4dgs().args(["demo", "-q", "--out"]).arg(folder.path().join(name)).output().unwrap();
        assert!(output.status.code() == Some(2) && common::said(&output).contains("not UTF-8"), "{}", common::said(&output));
    }
    let output = run(&["info", text(&broken), "--json"]);
    let object: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((output.status.code(), &object["error"]["exit_code"]), (Some(3), &Value::from(3)));
    // The result of an earlier command is not taken for that of one that failed.
    let file = folder.path().join("earlier.json");
    succeed(&["plugins", "cdf", "-q", "--json", text(&file)]);
    assert!(file.is_file());
    fail(&["info", text(&broken), "--json", text(&file)], 3);
    assert!(!file.exists());
}

#[cfg(not(feature = "view"))]
#[test]
fn commands_that_need_a_window_say_how_to_build_it() {
    let train = ["train", "--view", "--scene", "procedural", "--out", "no/such/folder"];
    let view = ["view", "--time", "0.5", "a.cc4d"];
    for (args, named) in [(&view[..1], "view:"), (&view[..], "view --time 0.5 a.cc4d:"), (&train[..], "train --view:")] {
        let message = fail(args, 2);
        assert!(message.contains(named) && message.contains("left out of this build") && message.contains("--features view"), "{message}");
    }
    let help = String::from_utf8(succeed(&["--help"]).stdout).unwrap();
    assert!(!help.contains("window"), "{help}");
}
