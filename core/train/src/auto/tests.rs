//! Lengths of plans, and the lines that say what was chosen.

use super::*;

#[test]
fn what_is_stated_is_not_in_the_plan() {
    let registry = Registry::collect().unwrap();
    let layers = Layers::collect(&registry, Some(PRESET), None, &["train.batch=3".into()]).unwrap();
    let mut plan = Plan::default();
    plan.add(Choice { settings: vec![("train.batch", 1.into()), ("train.zeta", 2.5.into())], reason: "because".into() }).unwrap();
    assert_eq!(plan.lines(&layers), ["train.zeta = 2.5 (because)"]);
    let config = layers.over(&plan.table).config().unwrap();
    assert_eq!((config.train.batch, config.train.zeta), (3, 2.5));
}

/// Views per iteration and iterations where `left` minutes are left, with the times that `cdf` took on the capture `turntable`.
fn planned(left: f64, batch: Option<usize>) -> (i64, i64) {
    planned_for(Arrangement::OneCameraAnywhere, 100, 193.0, left, batch)
}

/// As [`planned`], of so many training `views` that share `shared` ms.
fn planned_for(arrangement: Arrangement, views: usize, shared: f64, left: f64, batch: Option<usize>) -> (i64, i64) {
    let choices = choices(1.0, arrangement, views, shared, left, batch);
    (value(&choices, "train.batch"), value(&choices, "train.iterations"))
}

fn value(choices: &[Choice], key: &str) -> i64 {
    choices.iter().flat_map(|c| &c.settings).find(|(k, _)| *k == key).and_then(|(_, value)| value.as_integer()).unwrap()
}

/// What is chosen for [`planned_for`] and a stated `train.stretch`, with three minutes of which 0.2 pass before the iterations.
fn choices(stretch: f64, arrangement: Arrangement, views: usize, shared: f64, left: f64, batch: Option<usize>) -> Vec<Choice> {
    let registry = Registry::collect().unwrap();
    let mut config = Layers::collect(&registry, Some(PRESET), None, &[]).unwrap().config().unwrap();
    (config.train.shares, config.train.dynamic, config.train.stretch) = ([2.0, 0.0, 18.0], Dynamic::All, stretch);
    let facts = Facts {
        arrangement,
        views,
        cameras: 64,
        frames: 120,
        size: [192, 192],
        points: 0,
        transparent: 0.0,
        plain: None,
        mean: None,
        detail: 0.11,
        moving: None,
        occupied: None,
        noise: None,
        exposure: None,
        overlap: None,
    };
    let timing = Timing { still: 4.0, shared, per_time: 59.0, start: 0.0 };
    lengths(&facts, &config, timing, 3.0, [0.2, left], batch)
}

#[test]
fn an_iteration_has_fewer_views_where_too_few_iterations_fit() {
    assert_eq!(planned(12.0, None), (6, 1400), "what fits is left as it is");
    assert_eq!((planned(2.4, None), planned(1.45, None)), ((2, 501), (1, 377)));
    assert_eq!(planned(0.5, None), (1, LEAST_ITERATIONS as i64));
    assert_eq!(planned(2.4, Some(6)), (6, 280), "stated views are left as they are");
}

#[test]
fn a_stated_stretch_of_the_main_stage_is_planned_with() {
    let iterations = |stretch| value(&choices(stretch, Arrangement::OneCameraAnywhere, 100, 193.0, 2.4, Some(1)), "train.iterations");
    // An iteration takes 2.4 ms in the coarse stage, a tenth of them, and 256 ms in the main one.
    assert_eq!([1.0, 2.0, 0.8].map(iterations), [624, 312, 780]);
}

#[test]
fn a_plan_that_takes_longer_than_its_minutes_says_so() {
    let said = |shared| {
        let choices = choices(1.0, Arrangement::OneCameraAnywhere, 100, shared, 2.4, Some(1));
        choices.into_iter().find(|choice| choice.settings[0].0 == "train.iterations").unwrap().reason
    };
    assert_eq!(said(193.0), "2.4 of 3 minutes at about 231 ms per iteration on this machine");
    // 250 iterations, where 77 fit.
    let late = "2.4 of 3 minutes at about 1857 ms per iteration on this machine; these and the 0.2 minutes before them take about 7.9 minutes, not 3";
    assert_eq!(said(2000.0), late);
}

#[test]
fn an_iteration_is_planned_with_no_more_views_than_there_are() {
    let of = |views, batch| planned_for(Arrangement::OneCameraAnywhere, views, 193.0, 12.0, batch);
    assert_eq!(of(3, Some(64)), of(100, Some(3)), "training draws three");
    assert_eq!(of(3, None), of(100, Some(3)));
    assert_eq!((of(1, None).0, of(1, Some(4)).0), (1, 1));
}

#[test]
fn iterations_have_several_views_where_one_camera_at_a_time_sees_everything_move() {
    let views = |arrangement, left| planned_for(arrangement, 100, 10.0, left, None).0;
    let found = [2.0, 3.2, 4.5, 6.0, 9.0].map(|left| views(Arrangement::OneCameraAnywhere, left));
    assert_eq!(found, [1, 2, 3, 4, 4], "as many as leave 1,500 iterations");
    assert_eq!(views(Arrangement::OneMovingCamera, 9.0), 1);
}

#[test]
fn few_iterations_have_a_remedy_that_helps() {
    assert!(few(600, false).is_some_and(|line| line.starts_with("600 iterations are few") && line.contains("--minutes")));
    assert!(few(600, true).is_some_and(|line| line.contains("train.iterations") && !line.contains("--minutes")));
    assert_eq!((few(2000, false), few(2000, true)), (None, None));
}

#[test]
fn times_are_checked() {
    let with = |minutes| AutoConfig { minutes: Some(minutes), ..Default::default() }.validate();
    assert!(with(3.0).is_ok() && with(0.0).is_err() && with(f64::NAN).is_err() && with(1e9).is_err());
}
