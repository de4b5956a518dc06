use super::*;
use crate::sweep::{CellResult, ImageResult, Outcome, PlannedCell, Spread, example_plan};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

mod grouping;

const EVIL: &str = "<script>alert(1)</script>&\"'|`$x_1$\u{202e}";

/// The example of the documentation, changed.
fn cell(id: &str, change: impl FnOnce(&mut CellResult)) -> CellResult {
    let text = include_str!("../../../../docs/results.md");
    let json = text.split("```json\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let mut cell = CellResult::from_json("docs/results.md", json).unwrap();
    cell.id = id.into();
    change(&mut cell);
    cell
}

/// Two methods, two codecs, two seeds on a scene that is built in, with images of three frames.
fn sweep(folder: &Path) -> Vec<CellResult> {
    let mut cells = Vec::new();
    for (m, method) in ["cdf", "hexplane"].into_iter().enumerate() {
        for (c, codec) in ["cca-default", "cca-low"].into_iter().enumerate() {
            for seed in 0..2u64 {
                cells.push(cell(&format!("{method}-{c}-{seed}"), |r| {
                    r.axes = crate::sweep::Axes { scene: "tiny".into(), method: method.into(), setting: "base".into(), codec: codec.into(), seed };
                    // Names of a grid cannot have the colon of a profile.
                    r.provenance.codec.codec = codec.replace('-', ":");
                    (r.provenance.data.path, r.provenance.data.files) = ("procedural:tiny".into(), 0);
                    let psnr = 30.0 + m as f64 - 0.5 * c as f64 + 0.2 * seed as f64;
                    r.metrics.get_mut("psnr_db").unwrap().value = psnr;
                    r.storage.total_bytes = 700_000 - 200_000 * c as u64 + 100_000 * m as u64;
                    r.training = format!("{method}-{seed}");
                    r.images = (0..3)
                        .map(|frame| ImageResult {
                            camera: "c0".into(),
                            frame,
                            time_norm: frame as f32 / 2.0,
                            scores: BTreeMap::from([("psnr_db".into(), psnr + frame as f64)]),
                            blocks: None,
                            truth: Some(format!("images/truth/{frame}.png")),
                            render: Some(format!("images/{method}/{frame}.png")),
                        })
                        .collect();
                }));
            }
        }
    }
    let image = |shade: &dyn Fn(u32, u32) -> u8| {
        let data = (0..24 * 32).flat_map(|i| [shade(i % 32, i / 32); 3]).collect();
        cc4dgs_core::Image8 { width: 32, height: 24, channels: 3, data }
    };
    for frame in 0..3u32 {
        let write =
            |name: &str, shade: &dyn Fn(u32, u32) -> u8| crate::images::write_png(folder.join(format!("images/{name}/{frame}.png")), &image(shade)).unwrap();
        write("truth", &|x, y| (4 * x + y) as u8);
        // Right but for one corner, and flickering by ten levels.
        write("cdf", &|x, y| if x > 24 && y > 16 { 255 } else { (4 * x + y) as u8 });
        write("hexplane", &|x, y| (4 * x + y + 10 * (frame % 2)) as u8);
    }
    cells
}

fn write(folder: &Path, cells: &[CellResult]) {
    let results = folder.join("results");
    std::fs::create_dir_all(&results).unwrap();
    for (i, cell) in cells.iter().enumerate() {
        cell.write(&results.join(format!("{i}.json"))).unwrap();
    }
}

#[test]
fn a_report_has_all_parts_and_equal_bytes_again() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &sweep(folder.path()));
    let out = folder.path().join("deep/report.html");
    let files = write_report(folder.path(), &out, &ReportOptions::default()).unwrap();
    assert_eq!(files.cells, 8);
    let first = report(folder.path(), &ReportOptions::default()).unwrap();
    assert_eq!(std::fs::read_to_string(&out).unwrap(), first.html);
    assert_eq!(std::fs::read_to_string(&files.csv).unwrap(), first.csv);
    assert_eq!(first, report(folder.path(), &ReportOptions::default()).unwrap());
    for part in [
        "Rate and distortion",
        "Pareto front",
        "archive (MB)",
        "PSNR (dB)",
        "wall time (s)",
        "time (ms)",
        "size (MB)",
        "iteration",
        "frame",
        "Flicker",
        "slider",
        "reported, not run",
    ] {
        assert!(first.html.contains(part), "{part}");
    }
    for wrong in ["NaN", "inf\"", "http://", "https://", "<link", "src=\"/"] {
        assert!(!first.html.contains(wrong), "{wrong}");
    }
    for text in [&first.html, &first.markdown, &first.latex] {
        assert!(text.contains("test views: tiny 3 of 20 images"), "{text}");
    }
    // 4 rows; the mean of 31.0 and 31.2, the better of the two methods, is marked.
    assert_eq!(first.csv.lines().count(), 5);
    assert!(first.csv.lines().nth(3).unwrap().starts_with("tiny,hexplane,base,cca-default,done,2,31.1,"), "{}", first.csv);
    assert!(first.markdown.contains("**31.10 ± 0.14**") && first.latex.contains("\\textbf{31.10 $\\pm$ 0.14}"), "{}", first.markdown);
    // Plots as files, and tables of some columns.
    let options = ReportOptions { columns: ["size_mb", "psnr_db"].map(String::from).to_vec(), figures: Some(folder.path().join("svg")), ..Default::default() };
    let chosen = write_report(folder.path(), &out, &options).unwrap();
    let table = std::fs::read_to_string(&chosen.markdown).unwrap();
    assert!(table.contains("| seeds | size (MB) ↓ | PSNR (dB) ↑ |"), "{table}");
    let svg = std::fs::read_to_string(folder.path().join("svg/tiny-rate-and-distortion-psnr.svg")).unwrap();
    for part in ["xmlns=", "hexplane</text>", "cca-low</text>", "archive (MB)", ".axis {"] {
        assert!(svg.contains(part), "{part}");
    }
    assert!(!svg.contains("NaN") && !svg.contains("var(") && chosen.figures.len() > 5);
    let names: std::collections::BTreeSet<&PathBuf> = chosen.figures.iter().collect();
    assert_eq!(names.len(), chosen.figures.len(), "no two plots have one name");
    let wrong = ReportOptions { columns: vec!["speed".into()], ..Default::default() };
    assert!(report(folder.path(), &wrong).unwrap_err().to_string().contains("frame_ms"));
    // Numbers of papers are in tables of their own, below the notice.
    let notice = first.markdown.find("Reported by papers").unwrap();
    assert!(first.markdown.find("CC-4DGS").unwrap() > notice && !first.csv.contains("CC-4DGS"));
}

#[test]
fn the_best_of_a_column_is_one_of_several_that_did_not_fail() {
    let folder = tempfile::tempdir().unwrap();
    let cells = sweep(folder.path());
    let options = ReportOptions { columns: vec!["psnr_db".into()], images: ImageChoice::None, ..Default::default() };
    // Rows with a value in bold, after a change of the cells with these indices: two seeds for each of cdf, then of hexplane, with cca-default and cca-low.
    let bold = |changed: &[usize], change: &dyn Fn(&mut CellResult)| {
        let mut cells = cells.clone();
        changed.iter().for_each(|&i| change(&mut cells[i]));
        write(folder.path(), &cells);
        let markdown = report(folder.path(), &options).unwrap().markdown;
        markdown.lines().filter(|line| line.starts_with('|') && line.contains("**")).map(String::from).collect::<Vec<_>>()
    };
    let failed = |cell: &mut CellResult| cell.outcome = Outcome::Hopeless;
    assert_eq!(bold(&[], &failed), ["| hexplane | cca-default | 2 | **31.10 ± 0.14** |"]);
    assert_eq!(bold(&[4, 6], &failed), ["| cdf | cca-default | 2 | **30.10 ± 0.14** |"], "one seed is enough");
    assert!(bold(&[2, 4, 6], &failed).is_empty(), "only one is left to be the best");
    let unscored = |cell: &mut CellResult| _ = cell.metrics.remove("psnr_db");
    assert!(bold(&[0, 2, 6], &unscored).is_empty(), "only one has a mean");
}

/// The figure `name` of a report of `cells`, without images; `None` where there is none.
fn figure(folder: &Path, cells: &[CellResult], name: &str) -> Option<String> {
    write(folder, cells);
    let figures = report(folder, &ReportOptions { images: ImageChoice::None, ..Default::default() }).unwrap().figures;
    figures.into_iter().find(|(other, _)| other == name).map(|(_, svg)| svg)
}

#[test]
fn trainings_that_failed_are_not_on_the_pareto_front() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    let plot = |cells: &[CellResult]| figure(folder.path(), cells, "tiny-psnr-against-size.svg").unwrap();
    let rings = |plot: &str| plot.matches("class=\"onfront\"").count();
    let sound = plot(&cells);
    assert_eq!((rings(&sound), sound.contains("(failed)")), (3, false), "all but cdf with cca-default: hexplane with cca-low is smaller and better");
    // The smallest file, of a training with one seed that failed.
    cells[2].outcome = Outcome::Hopeless;
    let failed = plot(&cells);
    assert_eq!((rings(&failed), failed.contains("cdf / cca-low (failed)")), (2, true), "it is shown without a ring");
    assert!(failed.contains(">cdf (failed)</text>") && failed.contains(">hexplane</text>") && sound.contains(">cdf</text>"), "legends name it");
}

#[test]
fn scores_of_validation_views_are_drawn_where_there_are_some() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    let plot = |cells: &[CellResult]| figure(folder.path(), cells, "tiny-validation-views-by-time-a-line-per-seed.svg");
    assert!(plot(&cells).is_none());
    for cell in cells.iter_mut().filter(|c| c.axes.method == "cdf") {
        (cell.validation_curve.iteration, cell.validation_curve.psnr_db) = (vec![130, 2600], vec![20.0, 30.0]);
        cell.cost.validation_seconds = vec![60.0, 120.0];
    }
    let svg = plot(&cells).unwrap();
    assert_eq!(svg.matches("class=\"line\"").count(), 2, "a line per seed, once for both codecs");
    assert!(svg.contains("cdf</text>") && !svg.contains("hexplane</text>"), "{svg}");
    // Trainings that keep other numbers of views out are scored on other views.
    for cell in &mut cells {
        (cell.validation_curve.iteration, cell.validation_curve.psnr_db) = (vec![130, 2600], vec![20.0, 30.0]);
        cell.cost.validation_seconds = vec![60.0, 120.0];
        cell.provenance.configuration["train"]["validation"] = 12.into();
    }
    assert!(!plot(&cells).unwrap().contains("train.validation"));
    cells.iter_mut().filter(|c| c.axes.method == "cdf").for_each(|c| c.provenance.configuration["train"]["validation"] = 3.into());
    let svg = plot(&cells).unwrap();
    assert!(svg.contains("train.validation") && svg.contains("cdf 3; hexplane 12."), "{svg}");
    cells[0].validation_curve.psnr_db[1] = 1e300;
    write(folder.path(), &cells);
    assert!(report(folder.path(), &ReportOptions::default()).unwrap_err().to_string().contains("validation_curve"));
}

#[test]
fn times_of_trainings_on_other_devices_are_marked() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    let options = ReportOptions { columns: ["training_minutes", "psnr_db"].map(String::from).to_vec(), images: ImageChoice::None, ..Default::default() };
    let make = |cells: &[CellResult]| {
        write(folder.path(), cells);
        report(folder.path(), &options).unwrap()
    };
    let same = make(&cells);
    assert!(!same.markdown.contains("Training times") && !same.html.contains("Training times"), "{}", same.markdown);
    let plots = |report: &Report, part: &str| report.figures.iter().filter(|(_, svg)| svg.contains(part)).map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert!(plots(&same, "Training times").is_empty() && plots(&same, "class=\"onfront\"").contains(&"tiny-psnr-against-training-time.svg".to_string()));
    cells.iter_mut().filter(|c| c.axes.method == "cdf").for_each(|c| {
        let mut more = c.cost.training_devices[0].clone();
        more.device.threads = 8;
        c.cost.training_devices.push(more);
        c.cost.training_seconds = 60.0;
    });
    let made = make(&cells);
    let notes = made.markdown.matches("Training times are wall times on").count();
    assert!(notes == 1 && made.markdown.contains("do not compare") && !made.markdown.contains("**1.00"), "{}", made.markdown);
    assert!(made.html.contains("1.00 ±\u{a0}0.00 [1, 2]") && made.html.contains("3.00 ±\u{a0}0.00 [1]"), "{}", made.markdown);
    assert!(made.csv.lines().nth(1).unwrap().contains(" 1 thread; linux x86_64 + flex; "), "{}", made.csv);
    // So are the plots of these times, and no others.
    let marked = plots(&made, "Training times are wall times on [1] flex");
    assert!(marked.contains(&"tiny-psnr-against-training-time.svg".to_string()) && marked.iter().all(|name| name.contains("time")), "{marked:?}");
    assert!(
        marked.contains(&"tiny-training-views-by-time-a-line-per-seed.svg".to_string()) && !marked.iter().any(|name| name.contains("frame-time")),
        "{marked:?}"
    );
    assert!(!plots(&made, "class=\"onfront\"").contains(&marked[0]) && made.html.contains("Here: cdf [1, 2]; hexplane [1].</p>"), "{marked:?}");
    assert!(made.html.contains(", trained on [1, 2]</title>"), "{}", made.markdown);
}

#[test]
fn plots_of_scenes_that_differ_in_punctuation_have_names_of_their_own() {
    let mut figures = ["a-b.svg", "a-b-2.svg", "a-b.svg", "c.svg", "a-b.svg"].map(|name| (name.to_string(), String::new()));
    number_equals(&mut figures);
    assert_eq!(figures.map(|(name, _)| name), ["a-b.svg", "a-b-2.svg", "a-b-3.svg", "c.svg", "a-b-4.svg"]);
}

#[test]
fn a_report_replaces_reports_only() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &sweep(folder.path()));
    let out = folder.path().join("page/README.html");
    let options = ReportOptions { images: ImageChoice::None, figures: Some(folder.path().join("svg")), ..Default::default() };
    let make = || write_report(folder.path(), &out, &options);
    let files = make().unwrap();
    make().unwrap();
    let plot = &files.figures[0];
    for file in [&files.html, &files.csv, &files.markdown, &files.latex, plot] {
        let made = std::fs::read(file).unwrap();
        std::fs::write(file, "<p>mine</p>\n# Mine\n").unwrap();
        let message = make().unwrap_err().to_string();
        assert!(message.contains(&file.display().to_string()) && message.contains("exists already"), "{message}");
        assert_eq!(std::fs::read_to_string(file).unwrap(), "<p>mine</p>\n# Mine\n");
        std::fs::write(file, made).unwrap();
    }
    make().unwrap();
}

#[test]
fn images_are_shown_where_they_may_be_and_flicker_is_measured() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    write(folder.path(), &cells);
    let html = |images| report(folder.path(), &ReportOptions { images, views: 2, ..Default::default() }).unwrap().html;
    let count = |html: &str| html.matches("data:image/").count();
    // Two views of a truth (whole and square) and two renders (and an error map each), and a flicker map for each render.
    assert_eq!(count(&html(ImageChoice::BuiltIn)), 2 * (2 + 2 * 3) + 2);
    assert_eq!(count(&html(ImageChoice::None)), 0);
    let shown = html(ImageChoice::BuiltIn);
    assert!(shown.contains("camera c0: 10.00 of 255 levels") && shown.contains("camera c0: 0.00 of 255 levels"));
    // The square lies where the renders err: right and below.
    let style = shown.split("class=\"square\" style=\"left:").nth(1).unwrap();
    assert!(style.split('%').next().unwrap().parse::<f64>().unwrap() > 40.0, "{}", &style[..60]);
    // A sweep may be called `results` like the folder in it; a file in that folder is a result of the sweep, too.
    let outer = tempfile::tempdir().unwrap();
    let named = outer.path().join("results");
    write(&named, &sweep(&named));
    let of = |path: &Path| count(&report(path, &ReportOptions { images: ImageChoice::BuiltIn, views: 1, ..Default::default() }).unwrap().html);
    assert_eq!([named.clone(), named.join("results"), named.join("results/0.json")].map(|path| of(&path)), [10, 10, 6]);
    // A third-party scene is shown only on request.
    cells.iter_mut().for_each(|c| c.provenance.data.files = 3);
    write(folder.path(), &cells);
    assert_eq!((count(&html(ImageChoice::BuiltIn)), count(&html(ImageChoice::All))), (0, 18));
    // Without the files there is nothing to show.
    std::fs::remove_dir_all(folder.path().join("images")).unwrap();
    assert_eq!(count(&html(ImageChoice::All)), 0);
}

#[test]
fn strings_of_results_cannot_leave_their_place() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    for cell in &mut cells {
        cell.sweep = EVIL.into();
        cell.axes.scene = EVIL.into();
        cell.axes.method = format!("{}{EVIL}", cell.axes.method);
        cell.axes.codec = format!("{}{EVIL}", cell.axes.codec);
        (cell.outcome, cell.message) = (Outcome::Hopeless, Some(EVIL.into()));
        cell.absent = BTreeMap::from([("lpips".into(), EVIL.into())]);
        cell.provenance.commit = EVIL.into();
        cell.provenance.data.path = EVIL.into();
        cell.provenance.device.processor = EVIL.into();
        cell.cost.stage_seconds.insert(EVIL.into(), 3.0);
        cell.metrics.get_mut("ssim").unwrap().protocol.insert(EVIL.into(), EVIL.into());
        cell.images.iter_mut().for_each(|image| image.camera = EVIL.into());
    }
    write(folder.path(), &cells);
    let made = report(folder.path(), &ReportOptions { images: ImageChoice::All, ..Default::default() }).unwrap();
    assert!(made.html.contains("&lt;script&gt;alert(1)") && !made.html.contains("<script>alert") && !made.html.contains('\u{202e}'));
    assert_eq!(made.html.matches("<script>").count(), 1, "our own");
    assert!(!made.markdown.contains("<script>") && made.markdown.contains("\\|"));
    assert!(!made.latex.contains("$x_1$") && made.latex.contains("\\$x\\_1\\$"));
    assert!(made.csv.contains("\"<script>") || made.csv.contains("\"\"'"), "quotes are doubled");
}

#[test]
fn names_of_missing_cells_cannot_leave_their_place() {
    let folder = tempfile::tempdir().unwrap();
    let (training, ids) = ("00000000000000a0", ["00000000000000c0", "00000000000000c1"]);
    let result = cell(ids[0], |r| r.training = training.into());
    write(folder.path(), &[]);
    result.write(&folder.path().join("results").join(format!("{}.json", ids[0]))).unwrap();
    let planned = |id: &str| PlannedCell { id: id.into(), training: training.into(), codec: format!("c{id}"), choice: result.provenance.codec.clone() };
    let mut plan = example_plan();
    (plan.trainings[0].id, plan.trainings[0].scene) = (training.into(), "a\n\\input{x}<q>".into());
    plan.cells = ids.map(planned).to_vec();
    plan.write(folder.path()).unwrap();
    let made = report(folder.path(), &ReportOptions { images: ImageChoice::None, ..Default::default() }).unwrap();
    assert!(made.gap.unwrap().contains("\\input{x}") && made.latex.contains("\n% 1 of 2 cells"), "{}", made.latex);
    assert!(!made.latex.contains("\\input{x}") && !made.html.contains("<q>") && !made.markdown.contains("<q>"), "{}", made.latex);
}

#[test]
fn what_does_not_belong_together_is_refused() {
    let outer = tempfile::tempdir().unwrap();
    let folder = outer.path().join("sweep");
    let refused = |change: &dyn Fn(&mut Vec<CellResult>)| {
        let mut cells = sweep(&folder);
        change(&mut cells);
        std::fs::remove_dir_all(folder.join("results")).ok();
        write(&folder, &cells);
        report(&folder, &ReportOptions { images: ImageChoice::All, ..Default::default() }).unwrap_err().to_string()
    };
    assert!(refused(&|cells| cells[0].provenance.device.threads = 9).contains("two devices"));
    assert!(refused(&|cells| cells[1].axes.seed = 0).contains("two results"));
    assert!(refused(&|cells| cells[1].provenance.codec.field_weights = "int8".into()).contains("two codecs called 'cca-default'"));
    assert!(refused(&|cells| cells[0].metrics.get_mut("psnr_db").unwrap().value = 1e300).contains("1e300"));
    let flat = cc4dgs_core::Image8 { width: 32, height: 24, channels: 3, data: vec![7; 32 * 24 * 3] };
    crate::images::write_png(outer.path().join("private.png"), &flat).unwrap();
    let outside = refused(&|cells| cells.iter_mut().for_each(|c| c.images[0].truth = Some("../private.png".into())));
    assert!(outside.contains("outside the folder") && outside.contains("private.png"), "{outside}");
    let cells = sweep(&folder);
    std::fs::write(folder.join("images/cdf/1.png"), b"no image").unwrap();
    std::fs::remove_dir_all(folder.join("results")).unwrap();
    write(&folder, &cells);
    let error = report(&folder, &ReportOptions::default()).unwrap_err().to_string();
    assert!(error.contains("not a PNG image") && error.contains("images/cdf/1.png") && error.contains("file in the folder results"), "{error}");
    let options = |text: &str| ReportOptions { only: vec![text.into()], images: ImageChoice::None, ..Default::default() };
    assert_eq!(report(&folder, &options("method=cdf")).unwrap().cells, 4);
    let error = report(&folder, &options("method=none")).unwrap_err().to_string();
    assert!(error.contains("no result has method=none") && error.contains("cdf"), "{error}");
    assert!(report(&folder, &options("colour=red")).unwrap_err().to_string().contains("scene"));
    assert!(write_report(&folder, Path::new("report.txt"), &options("seed=0")).is_err());
}

#[test]
fn numbers_over_seeds() {
    let spread = Spread::of([1.0, 2.0, 6.0]).unwrap();
    assert_eq!((spread.mean, spread.low, spread.high), (3.0, 1.0, 6.0));
    assert!((spread.deviation.unwrap() - 7f64.sqrt()).abs() < 1e-12);
    assert_eq!((Spread::of([]), Spread::of([4.0]).unwrap().text(1)), (None, "4.0".into()));
    // A mean over some of the seeds would hide a gap.
    let (a, mut b) = (cell("a", |_| ()), cell("b", |r| r.axes.seed = 1));
    b.metrics.remove("ssim");
    let results = [a, b];
    let scenes = rows(&results).unwrap();
    let row = &scenes["mutant"][0];
    assert_eq!((row.cells.len(), row.spread(&rows::SSIM)), (2, None));
    assert!(row.spread(&rows::PSNR).is_some());
}
