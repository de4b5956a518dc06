//! What reports join by lines, show once for each training, and mark.

use super::*;

#[test]
fn lines_join_the_rates_of_one_codec_alone() {
    let folder = tempfile::tempdir().unwrap();
    let cells = sweep(folder.path());
    // Lines of the plot of PSNR against size.
    let lines = |cells: &[CellResult]| {
        let scenes = rows(cells).unwrap();
        let figures = charts::figures(&scenes["tiny"], &charts::Key::of(scenes.values().flatten()), &TrainingDevices::of(cells));
        figures.split("Rate and distortion: PSNR").nth(2).unwrap().split("</svg>").next().unwrap().matches("class=\"line\"").count()
    };
    // The same after a change of the smaller of the two files of each training.
    let lines_with = |change: &dyn Fn(&mut CellResult)| {
        let mut cells = cells.clone();
        cells.iter_mut().filter(|c| c.axes.codec == "cca-low").for_each(change);
        lines(&cells)
    };
    assert_eq!(lines(&cells), 2, "one per method");
    assert_eq!(lines_with(&|c| _ = c.provenance.codec.settings.insert("codebook".into(), 64.into())), 0, "a setting beside the profile is no rate");
    assert_eq!(lines_with(&|c| c.provenance.codec.codec = "vq:low".into()), 0, "two codecs");
    assert_eq!(lines_with(&|c| c.provenance.codec.field_weights = "int8".into()), 0, "two weight codecs");
    assert_eq!(lines_with(&|c| c.axes.setting = "wide".into()), 0, "two trainings");
    let settings = |other: &CellResult| {
        lines_with(&|c| (c.axes.setting, c.axes.codec, c.provenance.codec) = ("wide".into(), other.axes.codec.clone(), other.provenance.codec.clone()))
    };
    assert_eq!(settings(&cells[0]), 2, "settings of each method, stored by one codec");
    let failed = lines_with(&|c| {
        (c.axes.setting, c.axes.codec, c.provenance.codec) = ("wide".into(), cells[0].axes.codec.clone(), cells[0].provenance.codec.clone());
        c.outcome = Outcome::Hopeless;
    });
    assert_eq!(failed, 0, "trainings that failed are no point of a line of settings");
    // The codec of the Gaussians and the weight codec of each training's files, the larger one first.
    let lines_of = |larger: [&str; 2], smaller: [&str; 2]| {
        let mut cells = cells.clone();
        for cell in &mut cells {
            let [codec, weights] = if cell.axes.codec == "cca-low" { smaller } else { larger };
            (cell.provenance.codec.codec, cell.provenance.codec.field_weights) = (codec.into(), weights.into());
        }
        lines(&cells)
    };
    assert_eq!(lines_of(["compact:max-drop=0.05dB", "fp16"], ["compact:max-drop=0.2dB", "fp16"]), 2);
    assert_eq!(lines_of(["compact:psnr=60dB", "fp16"], ["compact:max-drop=0.2dB", "fp16"]), 0, "other keys");
    assert_eq!(lines_of(["raw", "compact:bits=9"], ["raw", "compact:bits=6.5"]), 2, "rates of the weight codec");
    assert_eq!(lines_of(["raw", "compact:array_bits=[9]"], ["raw", "compact:array_bits=[6]"]), 0, "no numbers");
    assert_eq!(lines_of(["cca:mid", "compact:bits=9"], ["cca:low", "compact:bits=6"]), 0, "the rates of two codecs");
}

#[test]
fn trainings_have_all_their_seeds_where_a_codec_lacks_some() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    let name = "tiny-training-views-by-iteration-a-line-per-seed.svg";
    // The first codec of the first method has one seed so far.
    cells.remove(1);
    let svg = figure(folder.path(), &cells, name).unwrap();
    assert_eq!(svg.matches("class=\"line\"").count(), 4, "two methods with two seeds");
}

#[test]
fn times_of_interrupted_trainings_and_views_that_were_kept_out_are_stated() {
    let folder = tempfile::tempdir().unwrap();
    let mut cells = sweep(folder.path());
    let options = ReportOptions { columns: ["training_minutes", "psnr_db"].map(String::from).to_vec(), images: ImageChoice::None, ..Default::default() };
    let make = |cells: &[CellResult]| {
        write(folder.path(), cells);
        report(folder.path(), &options).unwrap()
    };
    let whole = make(&cells);
    assert!(!whole.markdown.contains("interrupted") && !whole.markdown.contains("train.validation"), "{}", whole.markdown);
    // One seed of a training, which all codecs share.
    for cell in cells.iter_mut().filter(|c| c.axes.method == "cdf") {
        cell.cost.resumed = (2 * cell.axes.seed) as usize;
        cell.provenance.configuration["train"]["validation"] = 12.into();
    }
    let made = make(&cells);
    let said = "Training times of trainings that were interrupted include the work that was repeated: cdf (2 interruptions).";
    assert_eq!(made.markdown.matches(said).count(), 1, "{}", made.markdown);
    assert!(made.markdown.contains("fewer views than others: cdf 12; hexplane "), "{}", made.markdown);
    let names: Vec<&str> = made.figures.iter().filter(|(_, svg)| svg.contains("2 interruptions")).map(|(name, _)| name.as_str()).collect();
    assert!(names.contains(&"tiny-psnr-against-training-time.svg") && names.contains(&"tiny-training-views-by-time-a-line-per-seed.svg"), "{names:?}");
    assert!(names.iter().all(|name| name.contains("time")), "{names:?}");
}

#[test]
fn equal_means_are_not_in_bold() {
    let folder = tempfile::tempdir().unwrap();
    let cells = sweep(folder.path());
    // Two codecs of one training, which therefore has one time.
    write(folder.path(), &cells[..4]);
    let options = ReportOptions { columns: ["training_minutes", "psnr_db"].map(String::from).to_vec(), images: ImageChoice::None, ..Default::default() };
    let markdown = report(folder.path(), &options).unwrap().markdown;
    assert_eq!(markdown.matches("| 3.00 ± 0.00 |").count(), 2, "{markdown}");
    assert!(markdown.contains("| **30.10 ± 0.14** |") && markdown.matches("**").count() == 2, "{markdown}");
}
