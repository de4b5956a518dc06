//! What a page that draws by itself, with WebGL2, asks of the player: the arrays of the scene, and the uniforms of a frame.

use super::{Output, Player, error};
use crate::Scene;
use crate::render::{Frame, functions};
use cc4dgs_format::playback::Head;
use wasm_bindgen::prelude::*;

#[wasm_bindgen]
impl Player {
    fn plain_scene(&self) -> Option<&Scene> {
        if let Output::Plain { scene, .. } = &self.output { scene.as_ref() } else { None }
    }
    fn plain_scene_mut(&mut self) -> Option<&mut Scene> {
        if let Output::Plain { scene, .. } = &mut self.output { scene.as_mut() } else { None }
    }
    /// For WebGL2: the Gaussians (0) or the coefficients (1). They are handed over: the next call returns none.
    #[wasm_bindgen(js_name = plainFloats)]
    pub fn plain_floats(&mut self, which: usize) -> Vec<f32> {
        self.plain_scene_mut().map_or_else(Vec::new, |s| std::mem::take(if which == 0 { &mut s.gaussians } else { &mut s.coefficients }))
    }
    /// For WebGL2: the harmonics (0) or the starts (1), which are handed over, too; or per segment where starts and coefficients of the centres begin (2; all
    /// ones where centres do not move).
    #[wasm_bindgen(js_name = plainWords)]
    pub fn plain_words(&mut self, which: usize) -> Vec<u32> {
        self.plain_scene_mut().map_or_else(Vec::new, |s| match which {
            0 => std::mem::take(&mut s.harmonics),
            1 => std::mem::take(&mut s.starts),
            _ => s.tracks.iter().flat_map(|tracks| tracks[Head::Means as usize].map_or([u32::MAX; 2], <[u32; 2]>::from)).collect(),
        })
    }
    /// For WebGL2: the uniforms of a frame.
    #[wasm_bindgen(js_name = plainFrame)]
    pub fn plain_frame(&self, camera: Option<String>, time: Option<f32>) -> Result<Vec<u8>, JsError> {
        let view = self.view_of(camera, time)?;
        let empty;
        let scene = match self.plain_scene() {
            Some(scene) => scene,
            None => {
                empty = Scene::new(&Default::default(), None).map_err(error)?;
                &empty
            }
        };
        let (_, heads) = functions(scene, view.time);
        Ok(bytemuck::bytes_of(&Frame::new(scene, &view, view.background.unwrap_or(scene.background), heads)).to_vec())
    }
    /// For WebGL2: φ at a time.
    #[wasm_bindgen(js_name = plainFunctions)]
    pub fn plain_functions(&self, time: Option<f32>) -> Vec<f32> {
        self.plain_scene().map_or_else(Vec::new, |s| functions(s, time.unwrap_or(self.clock.time)).0)
    }
}
