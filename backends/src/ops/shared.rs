//! One gradient for several uses of a tensor.
//!
//! burn adds the gradients that the uses of a tensor return, one after the other, and each is as large as the tensor. Here every use stores its part of the
//! state, returns a token of one float in place of a gradient, and the gradient is computed once, when all uses are done.

use super::autodiff::{differentiate, record};
use crate::cpu::tensor::CpuBackend;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend};
use std::any::Any;
use std::fmt::{Debug, Formatter};
use std::marker::PhantomData;
use std::sync::{Mutex, PoisonError};

/// The parts that the uses of a tensor have stored, by index of the use.
pub struct Shared(Mutex<Vec<Option<Box<dyn Any + Send>>>>);

impl Debug for Shared {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.write_str("Shared")
    }
}

impl Shared {
    /// Space for the parts of `uses` uses.
    pub(super) fn new(uses: usize) -> Self {
        Self(Mutex::new((0..uses).map(|_| None).collect()))
    }
    /// Stores the part of the use `index`.
    pub(super) fn leave<T: Send + 'static>(&self, index: usize, value: T) {
        if let Some(slot) = self.0.lock().unwrap_or_else(PoisonError::into_inner).get_mut(index) {
            *slot = Some(Box::new(value));
        }
    }
    /// Takes the stored parts, in the order of the uses; `None` for a use that the loss does not depend on.
    pub(super) fn take<T: 'static>(&self) -> Vec<Option<T>> {
        let mut slots = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        slots.iter_mut().map(|slot| slot.take().and_then(|value| value.downcast().ok()).map(|value| *value)).collect()
    }
}

/// Tokens per device.
pub trait Token: Backend {
    /// A tensor of one float whose value is never used, on the device of `like`.
    fn token(like: &FloatTensor<Self>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> Token for B {
    fn token(_: &FloatTensor<Self>) -> FloatTensor<Self> {
        B::from_floats(vec![0.0], [1])
    }
}

#[cfg(feature = "cube")]
impl Token for burn_cubecl::CubeBackend {
    fn token(like: &FloatTensor<Self>) -> FloatTensor<Self> {
        crate::cube::tensor::floats(like, [1])
    }
}

/// The derivative of a tensor with shared uses: a function of their stored parts.
#[derive(Debug)]
struct Collect<S>(PhantomData<fn() -> S>);

impl<B: Backend, S: Clone + Send + Debug + 'static> Backward<B, 1> for Collect<S> {
    type State = (S, fn(S) -> FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(state, gradient), _token, [wanted]| [wanted.then(|| gradient(state))]);
    }
}

/// `tensor` itself, whose gradient is `gradient` of `state` once all its uses are done. Every use of the result must store its part and return a [`Token`].
pub(super) fn share<B: Backend, C: CheckpointStrategy, S: Clone + Send + Debug + 'static>(
    tensor: FloatTensor<Autodiff<B, C>>,
    state: S,
    gradient: fn(S) -> FloatTensor<B>,
) -> FloatTensor<Autodiff<B, C>> {
    let (tensor, parent) = tensor.into_parts();
    record::<B, C, _, 1>(Collect(PhantomData), [parent], |_| (tensor, (state, gradient)))
}
