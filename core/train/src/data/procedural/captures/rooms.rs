//! Furnished rooms: walls, floor and ceiling that fill every image, furniture along the walls, and a middle for what the capture is about.

use super::props::{Props, pose_at};
use crate::data::procedural::{Object, Pose, Shape, Texture};
use cc4dgs_core::Seed;
use glam::{DQuat, DVec3};
use std::f64::consts::FRAC_PI_2;

/// Half of the room's width and depth, in metres.
const HALF: f64 = 4.0;
/// Its height, in metres.
const HEIGHT: f64 = 3.0;
/// Half the thickness of a wall, in metres.
const THICK: f64 = 0.1;
/// The doorway of `Room::Door`: middle and half of its width along the wall at +y, and its height, in metres.
const DOOR: [f64; 3] = [1.85, 0.6, 2.1];

/// What is in the middle of a room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Room {
    /// Free floor, with a chair, a small table and a lamp around it.
    Open,
    /// A table and a chair behind it, seen from -y.
    Table,
    /// A table with things on it, and chairs.
    StillLife,
    /// As `Open`, with a doorway to a corridor.
    Door,
}

/// The room's walls and furniture; walls, furniture along them and the middle have seeds of their own.
pub(super) fn furnished(room: Room, seed: Seed) -> Vec<Object> {
    let mut props = Props::new(seed.child("walls"));
    walls(&mut props, room == Room::Door);
    let mut objects = props.objects;
    let mut props = Props::new(seed.child("furniture"));
    along_the_walls(&mut props, room == Room::Door);
    objects.append(&mut props.objects);
    let mut props = Props::new(seed.child("middle"));
    match room {
        Room::Open | Room::Door => open(&mut props),
        Room::Table => table(&mut props),
        Room::StillLife => still_life(&mut props),
    }
    objects.append(&mut props.objects);
    objects
}

/// A slab from corner to corner.
fn slab(props: &mut Props, low: DVec3, high: DVec3, texture: Texture) {
    props.solid(&Pose::at(DVec3::ZERO), Shape::Cuboid { half: 0.5 * (high - low) }, 0.5 * (low + high), texture);
}

fn walls(props: &mut Props, door: bool) {
    let (inner, outer) = (HALF, HALF + 2.0 * THICK);
    let (floor, plaster) = (props.planks(), props.rough([0.80, 0.78, 0.74], 0.5));
    let far = if door { 7.2 } else { outer };
    slab(props, DVec3::new(-outer, -outer, -2.0 * THICK), DVec3::new(outer, far, 0.0), floor);
    slab(props, DVec3::new(-outer, -outer, HEIGHT), DVec3::new(outer, far, HEIGHT + 2.0 * THICK), plaster);
    let kinds = props.order(4);
    let textures: Vec<Texture> = kinds.iter().map(|kind| props.wall(*kind)).collect();
    slab(props, DVec3::new(-outer, -outer, 0.0), DVec3::new(outer, -inner, HEIGHT), textures[0]);
    slab(props, DVec3::new(-outer, -inner, 0.0), DVec3::new(-inner, inner, HEIGHT), textures[1]);
    slab(props, DVec3::new(inner, -inner, 0.0), DVec3::new(outer, inner, HEIGHT), textures[2]);
    if !door {
        slab(props, DVec3::new(-outer, inner, 0.0), DVec3::new(outer, outer, HEIGHT), textures[3]);
        return;
    }
    let (left, right) = (DOOR[0] - DOOR[1], DOOR[0] + DOOR[1]);
    slab(props, DVec3::new(-outer, inner, 0.0), DVec3::new(left, outer, HEIGHT), textures[3]);
    slab(props, DVec3::new(right, inner, 0.0), DVec3::new(outer, outer, HEIGHT), textures[3]);
    slab(props, DVec3::new(left, inner, DOOR[2]), DVec3::new(right, outer, HEIGHT), textures[3]);
    // The corridor: its far wall and its ends.
    let corridor = props.wall(1);
    slab(props, DVec3::new(-outer, far, 0.0), DVec3::new(outer, far + 2.0 * THICK, HEIGHT), corridor);
    for side in [-1.0, 1.0] {
        let (a, b) = (DVec3::new(side * outer, outer, 0.0), DVec3::new(side * (outer - 2.0 * THICK), far, HEIGHT));
        slab(props, a.min(b), a.max(b), corridor);
    }
}

/// Three pieces along each wall in random order, posters and a window above them, and corners with plants and lamps.
fn along_the_walls(props: &mut Props, door: bool) {
    let order = props.order(12);
    for (slot, piece) in order.into_iter().enumerate() {
        let (wall, column) = (slot / 3, slot % 3);
        let turn = FRAC_PI_2 * wall as f64;
        let wall_frame = Pose::turned(DQuat::from_rotation_z(turn));
        let along = 2.15 * (column as f64 - 1.0) + props.range(-0.25, 0.25);
        // The door is in the wall at +y, which is not turned.
        let blocked = door && wall == 0 && (along - DOOR[0]).abs() < DOOR[1] + 1.0;
        let base = wall_frame.then(pose_at(along, HALF - 0.42, props.range(-0.06, 0.06)));
        if !blocked {
            furniture(props, piece, &base);
        }
        let above = DVec3::new(along + 0.9 * if column == 0 { 1.0 } else { -0.3 }, HALF - 0.015, props.range(1.75, 2.1));
        let hidden = door && wall == 0 && (above.x - DOOR[0]).abs() < DOOR[1] + 0.7;
        match column {
            _ if hidden => {}
            1 if wall % 2 == 0 => props.window(&wall_frame, DVec3::new(along, HALF - 0.01, 1.9)),
            _ => props.poster(&wall_frame, above),
        }
    }
    for corner in 0..4 {
        let at = Pose::turned(DQuat::from_rotation_z(FRAC_PI_2 * f64::from(corner))).then(pose_at(HALF - 0.5, HALF - 0.5, 0.0));
        if corner % 2 == 0 { props.plant(&at) } else { props.lamp(&at) }
    }
}

fn furniture(props: &mut Props, piece: usize, base: &Pose) {
    match piece {
        0 | 1 => props.sofa(base),
        2..=4 => props.shelf(base),
        5 | 6 => props.chest(base),
        7 | 8 => props.crates(base),
        9 => {
            props.table(base, [0.6, 0.32], 0.75);
            props.still_life(&base.then(Pose::at(DVec3::Z * 0.75)));
        }
        10 => props.plant(base),
        _ => props.chair(base),
    }
}

fn open(props: &mut Props) {
    let turn = props.range(-0.4, 0.4);
    props.rug(&pose_at(0.0, 0.0, turn), [1.0, 0.8]);
    let (a, b) = (props.range(-0.2, 0.2), props.range(-0.3, 0.3));
    props.chair(&pose_at(1.45, -1.25 + a, -2.2 + b));
    let side = pose_at(-1.5, 1.05 + a, 0.5 + b);
    props.table(&side, [0.32, 0.28], 0.55);
    props.vase(&side.then(Pose::at(DVec3::new(0.08, 0.05, 0.55))));
    props.lamp(&pose_at(-1.0, 1.5 + a, 0.0));
    props.rope(DVec3::new(-HALF, 1.6, 2.6), DVec3::new(1.6, HALF, 2.6), 0.5);
}

fn table(props: &mut Props) {
    props.rug(&pose_at(0.0, 1.0, 0.1), [1.3, 0.9]);
    props.table(&pose_at(0.0, 0.85, 0.0), [0.85, 0.42], 0.76);
    props.still_life(&pose_at(0.45, 0.85, 0.2).then(Pose::at(DVec3::Z * 0.76)));
    props.chair(&pose_at(0.05, 1.62, 0.0));
    props.chair(&pose_at(-1.4, 0.9, 1.9));
    props.lamp(&pose_at(1.35, 1.5, 0.0));
    props.plant(&pose_at(-1.5, 2.2, 0.0));
    props.rope(DVec3::new(-2.4, 1.9, HEIGHT), DVec3::new(2.2, 2.3, HEIGHT), 0.6);
}

fn still_life(props: &mut Props) {
    let turn = props.range(-0.5, 0.5);
    props.rug(&pose_at(0.0, 0.0, turn), [1.1, 0.9]);
    let base = pose_at(0.0, 0.0, turn);
    props.table(&base, [0.75, 0.45], 0.74);
    props.still_life(&base.then(Pose::at(DVec3::Z * 0.74)));
    props.chair(&base.then(pose_at(0.1, 0.75, 0.2)));
    props.chair(&base.then(pose_at(-1.1, -0.2, 1.8)));
    props.lamp(&base.then(pose_at(1.15, 0.5, 0.0)));
    props.plant(&base.then(pose_at(0.85, -0.7, 0.7)));
}
