//! A flat tensor that is split into pieces. Its gradient is assembled once.
//!
//! Slices would do the same, but the derivative of each is a tensor of zeros as large as the whole.
//!
//! The tensor holds heads one after the other, each `[rows, times x width]`: per row the outputs at one time after those at another. A piece is a head at one
//! time.

use super::autodiff::{differentiate, record};
use super::shared::{Shared, Token, share};
use crate::cpu::heads as kernel;
use crate::cpu::tensor::CpuBackend;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, backend_extension};
use burn::tensor::{Slice, Tensor};
use std::sync::Arc;

/// The layout of the whole tensor, and the gradients of its pieces as far as they are known.
#[derive(Debug)]
pub struct Pieces {
    /// How the pieces lie in the whole.
    layout: PieceLayout,
    gradients: Shared,
}

/// How pieces lie in a flat tensor. Pieces are counted time after time, and head after head within a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PieceLayout {
    /// Rows of every head.
    pub rows: usize,
    /// Outputs per row of each head at one time.
    pub widths: Vec<usize>,
    /// Times.
    pub times: usize,
}

impl PieceLayout {
    /// Numbers in all.
    pub fn len(&self) -> usize {
        self.rows * self.times * self.widths.iter().sum::<usize>()
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// The number of pieces.
    pub fn pieces(&self) -> usize {
        self.times * self.widths.len()
    }
    /// Head and time of the piece `index`.
    pub fn head_and_time(&self, index: usize) -> (usize, usize) {
        let heads = self.widths.len().max(1);
        (index % heads, index / heads)
    }
    /// Where `head` begins.
    pub fn start(&self, head: usize) -> usize {
        self.rows * self.times * self.widths[..head].iter().sum::<usize>()
    }
}

/// Assembly of pieces, per device.
pub trait SplitBackward: Token {
    /// The whole tensor of these pieces; zeros for those that are `None`.
    fn join(pieces: Vec<Option<FloatTensor<Self>>>, layout: &PieceLayout) -> FloatTensor<Self>;
}

/// The operations per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait SplitOps: Backend {
    /// `flat` itself; its gradient consists of those of its pieces.
    fn whole(flat: FloatTensor<Self>, pieces: Arc<Pieces>) -> FloatTensor<Self>;
    /// The piece `index`, flat, of a tensor that [`SplitOps::whole`] returned.
    fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self>;
}

/// The whole head of a piece: all of its rows at all times.
fn head_of<B: Backend>(whole: FloatTensor<B>, layout: &PieceLayout, head: usize) -> FloatTensor<B> {
    let start = layout.start(head);
    B::float_slice(whole, &[Slice::from(start..start + layout.rows * layout.times * layout.widths[head])])
}

impl<B: CpuBackend> SplitBackward for B {
    fn join(pieces: Vec<Option<FloatTensor<Self>>>, layout: &PieceLayout) -> FloatTensor<Self> {
        let values: Vec<_> = pieces.iter().map(|piece| piece.as_ref().map(|piece| B::floats(piece))).collect();
        let slices: Vec<Option<&[f32]>> = values.iter().map(|piece| piece.as_deref()).collect();
        B::from_floats(kernel::join(&slices, layout), [layout.len()])
    }
}

impl<B: CpuBackend> SplitOps for B {
    fn whole(flat: FloatTensor<Self>, _: Arc<Pieces>) -> FloatTensor<Self> {
        flat
    }
    fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self> {
        let layout = &pieces.layout;
        let (head, time) = layout.head_and_time(index);
        if layout.times == 1 {
            return head_of::<B>(whole, layout, head);
        }
        let (width, start) = (layout.widths[head], layout.start(head));
        let own = kernel::piece(&B::floats(&whole)[start..][..layout.rows * layout.times * width], width, layout.times, time);
        B::from_floats(own, [layout.rows * width])
    }
}

#[cfg(feature = "cube")]
mod cube {
    use super::{PieceLayout, Pieces, SplitBackward, SplitOps, head_of};
    use burn::backend::TensorMetadata;
    use burn::backend::ops::FloatTensorOps;
    use burn::backend::tensor::FloatTensor;
    use burn::tensor::{FloatDType, Slice};
    use burn_cubecl::CubeBackend;
    use std::sync::Arc;

    impl SplitBackward for CubeBackend {
        fn join(pieces: Vec<Option<FloatTensor<Self>>>, layout: &PieceLayout) -> FloatTensor<Self> {
            let Some(device) = pieces.iter().flatten().next().map(|piece| piece.device()) else {
                return Self::float_zeros([0].into(), &Default::default(), FloatDType::F32);
            };
            let (heads, rows) = (layout.widths.len(), layout.rows);
            let mut pieces = pieces;
            let mut of_head = |head: usize| {
                let width = layout.widths[head];
                let at = |time: usize| match pieces[time * heads + head].take() {
                    Some(piece) => Self::float_reshape(piece, [rows, width].into()),
                    None => Self::float_zeros([rows, width].into(), &device, FloatDType::F32),
                };
                let own: Vec<_> = (0..layout.times).map(at).collect();
                Self::float_reshape(Self::float_cat(own, 1), [rows * layout.times * width].into())
            };
            let all = (0..heads).map(&mut of_head).collect();
            Self::float_cat(all, 0)
        }
    }

    impl SplitOps for CubeBackend {
        fn whole(flat: FloatTensor<Self>, _: Arc<Pieces>) -> FloatTensor<Self> {
            flat
        }
        fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self> {
            let layout = &pieces.layout;
            let (head, time) = layout.head_and_time(index);
            let (rows, width) = (layout.rows, layout.widths[head]);
            let own = head_of::<Self>(whole, layout, head);
            if layout.times == 1 {
                return own;
            }
            let own = Self::float_reshape(own, [rows, layout.times * width].into());
            let at_time = Self::float_slice(own, &[Slice::from(0..rows), Slice::from(time * width..(time + 1) * width)]);
            Self::float_reshape(at_time, [rows * width].into())
        }
    }
}

#[derive(Debug)]
struct Piece;

impl<B: Token> Backward<B, 1> for Piece {
    type State = (Arc<Pieces>, usize);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(pieces, index), upstream, [wanted]| {
            [wanted.then(|| {
                let token = B::token(&upstream);
                pieces.gradients.leave(index, upstream);
                token
            })]
        });
    }
}

impl<B: SplitBackward + SplitOps, C: CheckpointStrategy> SplitOps for Autodiff<B, C> {
    fn whole(flat: FloatTensor<Self>, pieces: Arc<Pieces>) -> FloatTensor<Self> {
        share::<B, C, _>(flat, pieces, |pieces| B::join(pieces.gradients.take(), &pieces.layout))
    }
    fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self> {
        let (whole, parent) = whole.into_parts();
        record::<B, C, _, 1>(Piece, [parent], |_| (B::piece(whole, pieces.clone(), index), (pieces, index)))
    }
}

/// The pieces of `flat` of these lengths, one after the other; together they are as long as `flat`.
pub fn split(flat: Tensor<1>, lengths: Vec<usize>) -> Vec<Tensor<1>> {
    split_heads(flat, PieceLayout { rows: 1, widths: lengths, times: 1 })
}

/// The pieces of `flat`, each flat, in the order of `layout`, which is as long as `flat`.
pub fn split_heads(flat: Tensor<1>, layout: PieceLayout) -> Vec<Tensor<1>> {
    let count = layout.pieces();
    let pieces = Arc::new(Pieces { gradients: Shared::new(count), layout });
    let whole = <Dispatch as SplitOps>::whole(flat.into_dispatch(), pieces.clone());
    (0..count).map(|index| Tensor::from_dispatch(<Dispatch as SplitOps>::piece(whole.clone(), pieces.clone(), index))).collect()
}
