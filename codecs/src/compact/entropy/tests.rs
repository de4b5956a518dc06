//! The coder against a second, plain implementation, and streams that must never change.

use super::*;

/// Range coding as in Martin (1979) with 64-bit numbers and carries into the bytes already written, and models as lists of frequencies.
#[derive(Default)]
struct Plain {
    /// The code as a number in base 2^32, most significant digit first; the interval is [low, low + range) in the last two digits.
    digits: Vec<u32>,
    low: u64,
    range: Option<u64>,
}

impl Plain {
    fn symbol(&mut self, below: &[u32; 17], symbol: usize) {
        let range = self.range.unwrap_or(u64::MAX) >> 15;
        let (sum, carry) = self.low.overflowing_add(range * u64::from(below[symbol]));
        self.low = sum;
        if carry {
            self.carry();
        }
        let mut range = range * u64::from(below[symbol + 1] - below[symbol]);
        if range < 1 << 32 {
            self.digits.push((self.low >> 32) as u32);
            self.low <<= 32;
            range <<= 32;
        }
        self.range = Some(range);
    }
    fn carry(&mut self) {
        for digit in self.digits.iter_mut().rev() {
            *digit = digit.wrapping_add(1);
            if *digit != 0 {
                return;
            }
        }
    }
    /// Digits that lie in the interval whatever follows them.
    fn finish(mut self) -> Vec<u32> {
        let Some(range) = self.range else { return Vec::new() };
        let (point, carry) = self.low.overflowing_add(u64::from(u32::MAX));
        if carry {
            self.carry();
        }
        self.digits.push((point >> 32) as u32);
        if (self.low.wrapping_add(range) >> 32) as u32 == (point >> 32) as u32 {
            self.digits.push(0);
        }
        self.digits
    }
}

/// The model as frequencies that are recomputed from scratch.
struct Frequencies {
    below: [u32; 17],
    seen: u32,
}

impl Frequencies {
    fn update(&mut self, symbol: usize) {
        let shift = match self.seen {
            0..4 => 2,
            4..12 => 3,
            12..28 => 4,
            28..60 => 5,
            60..124 => 6,
            _ => 7,
        };
        for i in 1..16 {
            let target = if i <= symbol { i as i64 } else { 32768 - 16 + i as i64 };
            let difference = target - i64::from(self.below[i]);
            self.below[i] = (i64::from(self.below[i]) + difference.div_euclid(1 << shift)) as u32;
        }
        self.seen += 1;
    }
}

fn symbols(count: usize) -> Vec<usize> {
    let draw = |i: usize| cc4dgs_format::Seed::root(5).index(i as u64).value();
    (0..count).map(|i| if i % 700 < 350 { (draw(i) % 16) as usize } else { (draw(i).trailing_zeros() as usize).min(15) }).collect()
}

#[test]
fn a_plain_implementation_writes_the_same_words() {
    for count in [0, 1, 2, 50, 5000] {
        let (mut encoder, mut model) = (Encoder::default(), Model::default());
        let mut plain = Plain::default();
        let mut frequencies = Frequencies { below: std::array::from_fn(|i| 2048 * i as u32), seen: 0 };
        for s in symbols(count) {
            encoder.symbol(&mut model, s).unwrap();
            plain.symbol(&frequencies.below, s);
            frequencies.update(s);
        }
        let words: Vec<u8> = plain.finish().iter().flat_map(|w| w.to_le_bytes()).collect();
        assert_eq!(encoder.finish()[4..], words, "{count} symbols");
    }
}

#[test]
fn integers_come_back_and_nothing_may_follow() {
    let values: Vec<i64> = (0..3000i64).map(|i| (i * i * i % 1009 - 500) >> (i % 10)).chain([0, 1 << 40, -(1 << 40), 191, 192, 193, -192]).collect();
    let mut models = [Model::default(), Model::default(), Model::default()];
    let mut encoder = Encoder::default();
    let code = |coder: &mut dyn FnMut(&mut [Model; 3], i64) -> i64, models: &mut [Model; 3]| values.iter().map(|&v| coder(models, v)).collect::<Vec<_>>();
    code(
        &mut |[size, sign, other], v| {
            symmetric(&mut encoder, other, v).unwrap();
            signed(&mut encoder, size, sign, v).unwrap()
        },
        &mut models,
    );
    let bytes = encoder.finish();
    let mut models = [Model::default(), Model::default(), Model::default()];
    let mut decoder = Decoder::new("test", &bytes).unwrap();
    let found = code(
        &mut |[size, sign, other], _| {
            let first = symmetric(&mut decoder, other, 0).unwrap();
            let second = signed(&mut decoder, size, sign, 0).unwrap();
            assert_eq!(first, second);
            second
        },
        &mut models,
    );
    assert_eq!(found, values);
    decoder.finish().unwrap();
    let longer = [bytes.as_slice(), &[0]].concat();
    assert!(Decoder::new("test", &longer).unwrap().finish().is_err());
}

#[test]
fn no_symbol_becomes_impossible() {
    let mut model = Model::default();
    for s in (0..16).flat_map(|s| std::iter::repeat_n(s, 3000)) {
        model.update(s);
        assert!((0..16).all(|k| model.end(k) > u32::from(model.below[k])), "{:?}", model.below);
    }
}
