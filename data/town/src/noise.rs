//! Seeded noise on surfaces, filtered to the footprint of a pixel.

/// Mixes a seed and a lattice cell to 32 well-distributed bits.
pub fn hash(seed: u32, x: i32, y: i32) -> u32 {
    let mut h =
        seed ^ (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77).rotate_left(13);
    h = (h ^ (h >> 16)).wrapping_mul(0x7feb_352d);
    h = (h ^ (h >> 15)).wrapping_mul(0x846c_a68b);
    h ^ (h >> 16)
}

/// A number in [0, 1) from a seed and a cell.
pub fn uniform(seed: u32, x: i32, y: i32) -> f32 {
    (hash(seed, x, y) >> 8) as f32 / 16_777_216.0
}

/// The integer below; `f32::floor` is a library call on processors without SSE4.1, and this is the innermost loop.
pub fn floor(x: f32) -> i32 {
    let truncated = x as i32;
    truncated - i32::from(x < truncated as f32)
}

/// Value noise in [-1, 1] with lattice spacing 1.
pub fn value_noise(seed: u32, x: f32, y: f32) -> f32 {
    let (i, j) = (floor(x), floor(y));
    let (floor_x, floor_y) = (i as f32, j as f32);
    let fade = |t: f32| t * t * (3.0 - 2.0 * t);
    let (a, b) = (fade(x - floor_x), fade(y - floor_y));
    let low = uniform(seed, i, j) * (1.0 - a) + uniform(seed, i + 1, j) * a;
    let high = uniform(seed, i, j + 1) * (1.0 - a) + uniform(seed, i + 1, j + 1) * a;
    2.0 * (low * (1.0 - b) + high * b) - 1.0
}

/// How much of a pattern of this wavelength survives a pixel of this footprint: 1 well resolved, 0 not at all.
pub fn resolved(wavelength: f32, footprint: f32) -> f32 {
    (wavelength / footprint.max(1e-6) * 0.5 - 0.75).clamp(0.0, 1.0)
}

/// Octaves of value noise, each half the wavelength and `gain` times the height of the one before.
///
/// The first octave has the wavelength given (in the units of `x`, `y` and `footprint`); octaves that the footprint does not
/// resolve are left out.
pub fn octaves(seed: u32, x: f32, y: f32, footprint: f32, wavelength: f32, count: u32, gain: f32) -> f32 {
    let (mut sum, mut height, mut period) = (0.0, 1.0, wavelength);
    for octave in 0..count {
        let weight = resolved(period, footprint);
        if weight == 0.0 {
            break;
        }
        let scale = 1.0 / period;
        sum += weight
            * height
            * value_noise(seed.wrapping_add(octave.wrapping_mul(0x632b_e5ab)), x * scale, y * scale);
        height *= gain;
        period *= 0.5;
    }
    sum
}

/// Chips and spots: a disc of random place, size and height in [-1, 1] in every second cell of a square lattice, 0 elsewhere.
pub fn spots(seed: u32, x: f32, y: f32, footprint: f32, cell: f32) -> f32 {
    let (i, j) = (floor(x / cell), floor(y / cell));
    let bits = hash(seed, i, j);
    if bits & 1 == 0 {
        return 0.0;
    }
    let part = |shift: u32| ((bits >> shift) & 0xff) as f32 / 255.0;
    let radius = cell * (0.1 + 0.24 * part(1));
    let center = |shift, low: f32| low * cell + radius + part(shift) * (cell - 2.0 * radius);
    let distance = (x - center(9, i as f32)).hypot(y - center(17, j as f32));
    let cover = 1.0 - filtered_step(radius, distance, footprint);
    let height = if bits >> 25 & 1 == 1 { 1.0 } else { -1.0 };
    height * (0.4 + 0.6 * part(24)) * cover * resolved(2.0 * radius, footprint)
}

/// A step from 0 below `edge` to 1 above it, as wide as the footprint.
pub fn filtered_step(edge: f32, x: f32, footprint: f32) -> f32 {
    ((x - edge) / footprint.max(1e-4) + 0.5).clamp(0.0, 1.0)
}

/// 1 between `low` and `high`, 0 outside, with edges as wide as the footprint.
pub fn filtered_band(low: f32, high: f32, x: f32, footprint: f32) -> f32 {
    (filtered_step(low, x, footprint) - filtered_step(high, x, footprint)).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_over_the_lattice() {
        for k in -20..20 {
            let x = k as f32;
            assert!((value_noise(7, x - 1e-4, 0.3) - value_noise(7, x + 1e-4, 0.3)).abs() < 1e-3);
        }
    }

    #[test]
    fn unresolved_octaves_vanish() {
        assert_eq!(octaves(3, 1.3, 2.7, 1.0, 1.0, 6, 0.7), 0.0);
        assert_ne!(octaves(3, 1.3, 2.7, 0.01, 1.0, 6, 0.7), 0.0);
        assert_eq!(resolved(0.1, 0.1), 0.0);
        assert_eq!(resolved(1.0, 0.1), 1.0);
    }
}
