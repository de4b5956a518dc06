//! Scenes that look like what people bring: `procedural:captures/NAME`, or `procedural:captures/NAME:SEED` for another layout with other textures and noise.
//!
//! A capture is a room (or none), a cast that moves in it, a rig and its sensors. Training images are as a camera takes them; held-out images are the
//! truth, without noise, lens and differences of exposure. No capture brings initial points, a box or its background.

mod cast;
mod props;
mod rooms;

use super::{Noise, ProceduralScene, Rig, Sensors, unknown_scene};
use cast::Cast;
use cc4dgs_core::{Distortion, Error, Result, Seed, Similarity};
use rooms::Room;

/// Exposure of rooms: lamps and walls light them from all sides, the one light of the tracer does not.
const INDOORS: f64 = 1.4;
/// Lens of `lens`: a wide-angle camera's barrel.
const BARREL: Distortion = Distortion::Brown { radial: [-0.22, 0.05, 0.0, 0.0], tangential: [0.0; 2] };

/// The capture called `name`: one of [`super::NAMES`] without `captures/`, with `:SEED` if the seed is not 0.
///
/// # Errors
/// [`Error::Parameter`] for unknown names and for seeds that are not whole numbers from 0.
pub fn named(name: &str) -> Result<ProceduralScene> {
    let (kind, number) = match name.split_once(':') {
        Some((kind, seed)) => (kind, seed.parse::<u64>().map_err(|_| bad_seed(name, seed))?),
        None => (name, 0),
    };
    // Captures of one seed share their room, so that `exposure` is `dome` with other cameras.
    let seed = Seed::root(number).child("procedural").child("captures");
    let room = |plan: Room| rooms::furnished(plan, seed.child("room"));
    let (open, plain) = (room(Room::Open), Sensors { exposure: INDOORS, ..Sensors::IDEAL });
    let dome = |train: usize, test: usize| Rig::Dome { train, test, turns: 1.0 };
    let scene = |rig: Rig, frames: usize, cast: Cast, room| build(seed, rig, frames, cast, room);
    Ok(match kind {
        "dome" => scene(dome(16, 2), 30, cast::walkers(1.0), open),
        "rig" => {
            let grid = Rig::Grid { columns: 6, rows: 3, spacing: 0.26 };
            ProceduralScene { width: 216, height: 160, ..scene(grid, 40, cast::at_table(), room(Room::Table)) }
        }
        "handheld" => ProceduralScene { width: 216, height: 160, ..scene(Rig::Handheld { turns: 0.56 }, 144, cast::on_the_spot(), open) },
        "photos" => ProceduralScene { width: 240, height: 180, ..scene(Rig::Photos { count: 40 }, 1, Cast::default(), room(Room::StillLife)) },
        "turntable" => {
            ProceduralScene { width: 192, height: 192, sensors: Sensors::IDEAL, background: [1.0; 3], ..scene(Rig::Hemisphere, 120, cast::alone(), Vec::new()) }
        }
        "sparse" => scene(Rig::Dome { train: 4, test: 1, turns: 0.29 }, 30, cast::walkers(1.0), open),
        // Smaller, so that its 2,700 images are traced in half a minute.
        "long" => ProceduralScene { width: 160, height: 120, ..scene(dome(8, 1), 300, cast::walkers(6.0), open) },
        "exposure" => ProceduralScene { sensors: Sensors { gains: [0.7, 1.4], tint: 0.12, ..plain }, ..scene(dome(12, 2), 30, cast::walkers(1.0), open) },
        "lens" => ProceduralScene { sensors: Sensors { distortion: BARREL, ..plain }, ..scene(dome(12, 2), 30, cast::walkers(1.0), open) },
        "units" => {
            let millimetres = Similarity { scale: 1e3, translation: [412_000.0, -655_000.0, 230_000.0] };
            ProceduralScene { unit: millimetres, ..scene(dome(10, 2), 30, cast::walkers(1.0), open) }
        }
        "units-km" => {
            let kilometres = Similarity { scale: 1e-3, translation: [0.0; 3] };
            ProceduralScene { unit: kilometres, ..scene(dome(10, 2), 30, cast::walkers(1.0), open) }
        }
        "dark" => {
            let noise = Some(Noise { electrons: 350.0, read: 0.008 });
            ProceduralScene { sensors: Sensors { exposure: 0.3 * INDOORS, noise, ..plain }, ..scene(dome(12, 2), 30, cast::walkers(1.0), open) }
        }
        "appear" => scene(dome(12, 2), 30, cast::comers_and_goers(), room(Room::Door)),
        _ => return Err(unknown_scene(&format!("captures/{kind}"))),
    })
}

fn bad_seed(name: &str, seed: &str) -> Error {
    Error::parameter(format!("procedural scene 'captures/{name}'"), format!("the seed '{seed}' is not a whole number from 0"), "Write captures/NAME:7, say")
}

/// A capture in a room with ideal cameras, in metres. The cast comes first, so that its indices do not depend on the room.
fn build(seed: Seed, rig: Rig, frames: usize, cast: Cast, room: Vec<super::Object>) -> ProceduralScene {
    let Cast { mut objects, bodies } = cast;
    objects.extend(room);
    ProceduralScene {
        width: 192,
        height: 144,
        rig,
        sensors: Sensors { exposure: INDOORS, ..Sensors::IDEAL },
        frames,
        supersampling: 2,
        points: 0,
        point_noise: 0.0,
        seed,
        objects,
        bodies,
        background: [0.0; 3],
        background_is_stated: false,
        init_box: None,
        unit: Similarity::IDENTITY,
    }
}
