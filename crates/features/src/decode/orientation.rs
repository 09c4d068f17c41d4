/// Whether this EXIF orientation exchanges width and height.
pub(super) fn swaps_sides(orientation: u8) -> bool {
    (5..=8).contains(&orientation)
}

/// Turns pixels of so many bytes upright by the EXIF orientation (1 to 8; TIFF 6.0 tag 274).
pub(super) fn upright(
    orientation: u8,
    (width, height): (u32, u32),
    values: Vec<u8>,
    per_pixel: usize,
) -> (u32, u32, Vec<u8>) {
    if !(2..=8).contains(&orientation) {
        return (width, height, values);
    }
    let (w, h) = (width as usize, height as usize);
    let (out_w, out_h) = if swaps_sides(orientation) { (h, w) } else { (w, h) };
    let mut turned = Vec::with_capacity(values.len());
    for y in 0..out_h {
        for x in 0..out_w {
            let (column, row) = match orientation {
                2 => (w - 1 - x, y),
                3 => (w - 1 - x, h - 1 - y),
                4 => (x, h - 1 - y),
                5 => (y, x),
                6 => (y, h - 1 - x),
                7 => (w - 1 - y, h - 1 - x),
                _ => (w - 1 - y, x),
            };
            let at = (row * w + column) * per_pixel;
            turned.extend_from_slice(&values[at..at + per_pixel]);
        }
    }
    (out_w as u32, out_h as u32, turned)
}
