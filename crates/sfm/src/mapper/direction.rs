use nalgebra::Vector3;

/// Cells along each side of a cube's face.
const SIDE: usize = 4;
/// Number of cells on the sphere: the faces of a cube, cut into squares.
pub(super) const CELLS: usize = 6 * SIDE * SIDE;

/// The cell that a direction of any length falls into; `None` for the zero vector.
pub(super) fn cell(direction: &Vector3<f64>) -> Option<usize> {
    let axis = direction.iamax();
    let largest = direction[axis].abs();
    if !(largest > 0.0) {
        return None;
    }
    let face = axis * 2 + usize::from(direction[axis] < 0.0);
    let along = |value: f64| (((value / largest + 1.0) * 0.5 * SIDE as f64) as usize).min(SIDE - 1);
    Some((face * SIDE + along(direction[(axis + 1) % 3])) * SIDE + along(direction[(axis + 2) % 3]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_on_all_sides_get_their_own_cells() {
        let mut cells: Vec<usize> = (0..3)
            .flat_map(|axis| [1.0, -1.0].map(|sign| Vector3::ith(axis, sign) + Vector3::new(0.1, 0.2, 0.3)))
            .filter_map(|direction| cell(&direction))
            .collect();
        cells.sort_unstable();
        cells.dedup();
        assert_eq!(cells.len(), 6);
        assert!(cells.iter().all(|&cell| cell < CELLS));
        assert_eq!(cell(&Vector3::zeros()), None);
    }
}
