//! Exact images for the window of `cc4dgs view`: by the deformer and the rasterizer of the model, on the device of the run.

use super::STACK;
use crate::models::load_model;
use cc4dgs_core::archive::{Archive, StreamKind};
use cc4dgs_core::{Error, Limits, Registry, Result, Silent};
use cc4dgs_play::model::Model;
use cc4dgs_play::player::{FrameOptions, Player};
use cc4dgs_play::source::{Source, SourceKind};
use cc4dgs_player::exact::{Exact, ExactImages, ExactRequests};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// The exact images of the model at `path`, or why there are none. The model is opened when the first is asked for; it must be the file of now.
pub fn of_file(path: &Path, device: &str, limits: Limits) -> Exact {
    match ModelImages::find(path, device, limits) {
        Ok(images) => Ok(Box::new(images)),
        Err(e) => Err(e.to_string()),
    }
}

struct ModelImages {
    file: PathBuf,
    /// Size and time of the last change.
    version: (u64, Option<SystemTime>),
    device: String,
    limits: Limits,
}

impl ModelImages {
    fn find(path: &Path, device: &str, limits: Limits) -> Result<Self> {
        let Source { kind, file } = Source::expect(path)?;
        let version = version(&file)?;
        if kind == SourceKind::Archive {
            check(&file, &limits)?;
        }
        Ok(Self { file, version, device: device.to_string(), limits })
    }
}

/// Refuses archives whose deformer was left out, or is not linked.
fn check(file: &Path, limits: &Limits) -> Result<()> {
    let archive = Archive::open(file, limits)?;
    let Some(entry) = &archive.manifest().deformer else { return Ok(()) };
    if !archive.stream_sizes().iter().any(|s| s.kind == StreamKind::Field) {
        let problem = "it was baked without its deformer, and moves by its playback layer alone";
        return Err(Error::unsupported(file.display().to_string(), problem, "Open the model that it was baked from"));
    }
    Registry::collect()?.deformer(&entry.name).map(|_| ())
}

fn version(file: &Path) -> Result<(u64, Option<SystemTime>)> {
    let found = std::fs::metadata(file).map_err(|e| Error::io(file, e))?;
    // Not every file system knows times.
    Ok((found.len(), found.modified().ok()))
}

fn kind(section: &toml::Table) -> &str {
    section.get("kind").and_then(|kind| kind.as_str()).unwrap_or_default()
}

/// What draws `model`, in words.
fn described(model: &Model, device: &str) -> String {
    let deformer = model.field.as_ref().map_or_else(|| "no deformer".to_string(), |field| format!("deformer {}", field.name()));
    format!("{deformer}, rasterizer {}, on {device}", kind(&model.rasterizer))
}

impl ExactImages for ModelImages {
    fn serve(&mut self, requests: &ExactRequests) -> Result<()> {
        // A pool of its own: a parallel operation then starts on the thread that calls it, as in all commands, and the thread that waits for requests is not
        // missing in the common pool.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(rayon::current_num_threads()).stack_size(STACK).build();
        let pool = pool.map_err(|e| Error::backend("exact images", e.to_string(), "Give fewer --threads"))?;
        pool.install(|| {
            if version(&self.file)? != self.version {
                let problem = "the file has changed since the window was opened";
                return Err(Error::data(self.file.display().to_string(), problem, "Open it again"));
            }
            let registry = Registry::collect()?;
            let loaded = load_model(&self.file, &self.device, &registry, &self.limits, &Silent)?;
            let mut player = Player::new(&loaded.model, &registry, &loaded.device)?;
            requests.each(&described(&loaded.model, &loaded.device_name), |view| {
                player.frame_as(&view.camera, view.time, FrameOptions { sh_degree: view.sh_degree, scale: view.scale })
            });
            Ok(())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs::playable::{PlayableOptions, Storage, Stored, Surroundings};
    use cc4dgs::{Image8, Orbit, Session};
    use cc4dgs_player::View;
    use cc4dgs_player::exact::ExactWorker;
    use std::sync::atomic::AtomicBool;
    use std::sync::mpsc::channel;
    use std::time::Duration;

    const PATIENCE: Duration = Duration::from_secs(120);

    fn bake(session: &Session, plain: &Path, out: &Path, without_field: bool) {
        let stop = AtomicBool::new(false);
        let around = Surroundings::of(session, &stop);
        let stored = Stored::open(plain, Storage::default(), around).unwrap();
        let presentation = stored.presentation(&[], None).unwrap();
        let options = PlayableOptions { max_error: None, cameras: &[], presentation, poster: false, without_field, baked: true };
        std::fs::write(out, stored.playable(options, around).unwrap().bytes).unwrap();
    }

    fn image(exact: Exact, view: &View) -> Result<(Image8, String)> {
        let (wake, woken) = channel();
        let worker = ExactWorker::new(exact.expect("exact images"), move || _ = wake.send(())).unwrap();
        worker.ask(view.clone());
        woken.recv_timeout(PATIENCE).expect("an answer");
        let image = worker.take().unwrap();
        assert_eq!(&image.view, view);
        // The worker waits while the window is open, on a thread that does not belong to the common pool.
        let (answer, answered) = channel();
        std::thread::spawn(move || answer.send(rayon::broadcast(|_| ()).len()));
        answered.recv_timeout(PATIENCE).expect("all threads of the pool are free");
        Ok((image.result?, image.renderer))
    }

    #[test]
    fn they_are_those_of_the_deformer_where_the_file_has_it() {
        let session = Session::builder().device("flex").build().unwrap();
        let config = session.config("demo", &["train.iterations=30", "train.dynamic=all", "train.checks=false", "deformer.kind=cdf-basis"]).unwrap();
        let model = session.train(&config, session.read_scene("procedural:tiny", &config.scene).unwrap(), None).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let [plain, baked, alone, ply] = ["plain.cc4d", "baked.cc4d", "alone.cc4d", "still.ply"].map(|name| folder.path().join(name));
        model.save(&plain, "raw").unwrap();
        bake(&session, &plain, &baked, false);
        bake(&session, &plain, &alone, true);
        std::fs::write(&ply, cc4dgs_core::ply::to_bytes(&model.gaussians, true).unwrap()).unwrap();
        let camera = Orbit { size: (80, 60), frames: 1, ..Orbit::default() }.around(&model.gaussians).unwrap().remove(0);
        let view = View::new(camera, 0.7);
        let of = |path: &Path| of_file(path, "flex", Limits::default());
        for (path, by) in [
            (&plain, "deformer cdf-basis, rasterizer tile, on flex"),
            (&baked, "deformer cdf-basis, rasterizer tile, on flex"),
            (&ply, "no deformer, rasterizer tile, on flex"),
        ] {
            let model = session.open(path).unwrap();
            let mut player = session.player(&model).unwrap();
            let (drawn, renderer) = image(of(path), &view).unwrap();
            assert_eq!(renderer, by);
            assert!(drawn.data == player.frame(&view.camera, 0.7).unwrap().data, "{} is drawn by its deformer", path.display());
            let other = View { scale: 0.5, sh_degree: 0, ..view.clone() };
            let options = FrameOptions { sh_degree: 0, scale: 0.5 };
            let (changed, _) = image(of(path), &other).unwrap();
            assert!(changed.data == player.frame_as(&other.camera, 0.7, options).unwrap().data && changed.data != drawn.data);
        }
        assert!(of(&alone).err().unwrap().contains("baked without its deformer"));
        assert!(of(&folder.path().join("missing")).is_err());
        let message = image(of_file(&plain, "abacus", Limits::default()), &view).unwrap_err().to_string();
        assert!(message.contains("abacus"), "{message}");
        let exact = of(&plain);
        std::fs::copy(&ply, &plain).unwrap();
        let message = image(exact, &view).unwrap_err().to_string();
        assert!(message.contains("has changed"), "{message}");
    }
}
