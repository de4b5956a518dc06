//! The sort of tile lists and shared vertices, on every device.

use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_backends::ops::sort::sort_order;
use cc4dgs_tests::{devices, poison};
use rand::{Rng, SeedableRng};

#[test]
fn orders_are_ascending_and_stable() {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
    for (name, device) in devices() {
        // Sizes around the capacity of one workgroup, one block and one pass.
        for count in [1, 2, 255, 256, 257, 1023, 1024, 1025, 70_000] {
            for bits in [1, 8, 9, 17, 32] {
                let keys: Vec<u32> = (0..count).map(|i| if i % 3 == 0 { random.random_range(0..7) } else { random.random() }).collect();
                poison(&device);
                let given = Tensor::<1, Int>::from_data(TensorData::new(keys.iter().map(|&k| k as i32).collect::<Vec<i32>>(), [count]), &device);
                let order: Vec<usize> = sort_order(given, bits).unwrap().into_data().iter::<i64>().map(|i| i as usize).collect();
                let mut wanted: Vec<usize> = (0..count).collect();
                wanted.sort_by_key(|&i| keys[i] & (u32::MAX >> (32 - bits)));
                assert!(order == wanted, "{name}: {count} keys of {bits} bits");
            }
        }
        assert!(sort_order(Tensor::<1, Int>::from_data([3, 1], &device), 33).is_err());
    }
}
