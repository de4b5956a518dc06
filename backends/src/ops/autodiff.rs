//! One way into burn's graph for every operation with a hand-written derivative: [`record`] forwards, [`differentiate`] backwards.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend};

/// Runs `compute` and, if any of `parents` needs a gradient, puts its output into the graph with `derivative` behind it.
///
/// `compute` gets whether a gradient will be needed, and returns the output and what the derivative needs.
pub(super) fn record<B, C, D, const N: usize>(
    derivative: D,
    parents: [NodeGuard; N],
    compute: impl FnOnce(bool) -> (FloatTensor<B>, D::State),
) -> FloatTensor<Autodiff<B, C>>
where
    B: Backend,
    C: CheckpointStrategy,
    D: Backward<B, N>,
{
    let compute = |tracked| {
        let (output, state) = compute(tracked);
        (output, state, ())
    };
    record_beside::<B, C, D, (), N>(derivative, parents, compute).0
}

/// As [`record`], for operations with further results that have no gradient.
pub(super) fn record_beside<B, C, D, T, const N: usize>(
    derivative: D,
    parents: [NodeGuard; N],
    compute: impl FnOnce(bool) -> (FloatTensor<B>, D::State, T),
) -> (FloatTensor<Autodiff<B, C>>, T)
where
    B: Backend,
    C: CheckpointStrategy,
    D: Backward<B, N>,
{
    match derivative.prepare::<C>(parents).compute_bound().stateful() {
        OpsKind::Tracked(prep) => {
            let (output, state, beside) = compute(true);
            (prep.finish(state, output), beside)
        }
        OpsKind::UnTracked(prep) => {
            let (output, _, beside) = compute(false);
            (prep.finish(output), beside)
        }
    }
}

/// Takes the gradient of an operation's output and gives its parents theirs. `gradients` gets the saved state, the gradient of the output, and which
/// parents want one.
pub(super) fn differentiate<B, S, const N: usize>(
    ops: Ops<S, N>,
    grads: &mut Gradients,
    gradients: impl FnOnce(S, FloatTensor<B>, [bool; N]) -> [Option<FloatTensor<B>>; N],
) where
    B: Backend,
{
    let upstream = grads.consume::<B>(&ops.node);
    let wanted = ops.parents.each_ref().map(Option::is_some);
    for (parent, gradient) in ops.parents.into_iter().zip(gradients(ops.state, upstream, wanted)) {
        if let (Some(parent), Some(gradient)) = (parent, gradient) {
            grads.register::<B>(parent.id, gradient);
        }
    }
}
