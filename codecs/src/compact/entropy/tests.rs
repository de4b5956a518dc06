//! The coder against a second, plain implementation, and streams that must never change.

use super::*;

/// Asymmetric numeral systems as in Duda (2013), with words of 32 bits, from probabilities that are computed with floats.
fn plain(notes: &[(usize, usize)], levels: &[[u32; SYMBOLS]]) -> Vec<u32> {
    let (mut state, mut words) = (0u64, Vec::new());
    for &(context, symbol) in notes.iter().rev() {
        let weights =
            levels[context].map(|l| if l == 0 { 0.0 } else { (1024.0 * (0.25 * f64::from((l - 1) % 4)).exp2()).round() * f64::from((l - 1) / 4).exp2() });
        let total: f64 = weights.iter().sum();
        let mut shares = weights.map(|w| if w == 0.0 { 0 } else { ((w * 32768.0 / total).floor() as u64).max(1) });
        let largest = shares.iter().position(|s| s == shares.iter().max().unwrap()).unwrap();
        shares[largest] = (shares[largest] + 32768).wrapping_sub(shares.iter().sum());
        let (start, width) = (shares[..symbol].iter().sum::<u64>(), shares[symbol]);
        if state >> 49 >= width {
            words.push(state as u32);
            state >>= 32;
        }
        state = (state / width) << 15 | (start + state % width);
    }
    words.extend([state as u32, (state >> 32) as u32]);
    while words.last() == Some(&0) {
        words.pop();
    }
    words
}

fn notes(count: usize) -> Vec<(usize, usize)> {
    let draw = |i: usize| cc4dgs_format::Seed::root(5).index(i as u64).value();
    let symbol = |i: usize| if i.is_multiple_of(3) { (draw(i) % 16) as usize } else { (draw(i).trailing_zeros() as usize).min(15) };
    (0..count).map(|i| (i % 3, symbol(i))).collect()
}

#[test]
fn a_plain_implementation_writes_the_same_words() {
    for count in [0, 1, 2, 50, 5000] {
        let notes = notes(count);
        let mut encoder = Encoder::default();
        for (i, &(context, symbol)) in notes.iter().enumerate() {
            encoder.symbol(i % LANES, context, symbol).unwrap();
        }
        let (tables, stored) = Tables::fit(4, std::slice::from_ref(&encoder));
        let mut bits = BitReader::new(&stored);
        let levels: Vec<[u32; SYMBOLS]> = (0..4).map(|_| if bits.take(1) == Some(1) { read_levels(&mut bits).unwrap() } else { [1; SYMBOLS] }).collect();
        let lanes: Vec<Vec<u32>> = (0..LANES).map(|lane| plain(&notes.iter().skip(lane).step_by(LANES).copied().collect::<Vec<_>>(), &levels)).collect();
        let mut expected = Vec::new();
        for words in &lanes {
            match words.len() {
                few @ 0..128 => expected.push(few as u8),
                many => expected.extend([many as u8 | 128, (many >> 7) as u8]),
            }
        }
        expected.extend(lanes.iter().flatten().flat_map(|w| w.to_le_bytes()));
        let bytes = encoder.finish(&tables).unwrap();
        assert_eq!(bytes, expected, "{count} symbols");
        let tables = Tables::read("test", 4, &stored).unwrap();
        let mut decoder = Decoder::new("test", &tables, &bytes).unwrap();
        assert!(notes.iter().enumerate().all(|(i, &(context, symbol))| decoder.symbol(i % LANES, context, 0).unwrap() == symbol));
        decoder.finish().unwrap();
    }
}

#[test]
fn stored_distributions_cost_little() {
    let notes = notes(30_000);
    let mut encoder = Encoder::default();
    for &(context, symbol) in &notes {
        encoder.symbol(0, context, symbol).unwrap();
    }
    let mut counts = [[0.0f64; SYMBOLS]; 3];
    notes.iter().for_each(|&(context, symbol)| counts[context][symbol] += 1.0);
    let bits: f64 = counts.iter().flat_map(|c| c.iter().filter(|n| **n > 0.0).map(|n| -n * (n / c.iter().sum::<f64>()).log2())).sum();
    let (tables, stored) = Tables::fit(3, std::slice::from_ref(&encoder));
    let found = 8.0 * (stored.len() + encoder.finish(&tables).unwrap().len()) as f64;
    assert!(found < 1.006 * bits, "{found} bits, the entropy is {bits}");
}

#[test]
fn integers_come_back_and_nothing_may_follow() {
    let values: Vec<i64> = (0..3000i64).map(|i| (i * i * i % 1009 - 500) >> (i % 10)).chain([0, 1 << 40, -(1 << 40), 191, 192, 193, -192]).collect();
    let mut encoder = Encoder::default();
    for (i, &v) in values.iter().enumerate() {
        symmetric(&mut encoder, i % LANES, 2, v).unwrap();
        signed(&mut encoder, i % 3, 0, 1, v).unwrap();
    }
    let (tables, _) = Tables::fit(3, std::slice::from_ref(&encoder));
    let bytes = encoder.finish(&tables).unwrap();
    let mut decoder = Decoder::new("test", &tables, &bytes).unwrap();
    for (i, &v) in values.iter().enumerate() {
        assert_eq!((symmetric(&mut decoder, i % LANES, 2, 0).unwrap(), signed(&mut decoder, i % 3, 0, 1, 0).unwrap()), (v, v));
    }
    decoder.finish().unwrap();
    let longer = [bytes.as_slice(), &[0]].concat();
    assert!(Decoder::new("test", &tables, &longer).unwrap().finish().is_err());
}

#[test]
fn numbers_of_words_have_32_bits() {
    let (tables, _) = Tables::fit(1, &[]);
    let refused = |bytes: &[u8]| Decoder::new("test", &tables, bytes).map(|_| ()).unwrap_err().to_string();
    for last in [0x10, 0x8f] {
        let message = refused(&[0x80, 0x80, 0x80, 0x80, last]);
        assert!(message.contains("too long"), "{message}");
    }
    let message = refused(&[0xff, 0xff, 0xff, 0xff, 0x0f, 0, 0, 0]);
    assert!(message.contains("bytes expected"), "{message}");
}

#[test]
fn every_stored_distribution_is_whole() {
    for seed in 0..500u64 {
        let draw = |s: usize| cc4dgs_format::Seed::root(seed).index(s as u64).value();
        let levels: [u32; SYMBOLS] = std::array::from_fn(|s| if draw(s) % 3 == 0 { 0 } else { (draw(s) >> 20) as u32 % (MOST_LIKELY + 1) });
        let Some(table) = Table::from_levels(&levels) else { continue };
        let mut below = 0;
        for (symbol, level) in levels.into_iter().enumerate() {
            let (start, width) = table.interval(symbol);
            assert_eq!((start, width > 0), (below, level > 0));
            below += width;
            for quantile in [start, below.saturating_sub(1)].into_iter().filter(|_| width > 0) {
                assert_eq!(table.quantile_function(quantile).0, symbol);
            }
        }
        assert_eq!(below, ONE);
    }
}
