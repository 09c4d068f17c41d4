//! Directions in cells of equal kind all over the sphere.

use nalgebra::Vector3;

/// Cells along each side of a cube's face.
const SIDE: usize = 4;
/// Number of cells on the sphere: the faces of a cube, cut into squares.
pub(crate) const CELLS: usize = 6 * SIDE * SIDE;

/// The cell that a direction of any length falls into; `None` for the zero vector.
pub(crate) fn cell(direction: &Vector3<f64>) -> Option<usize> {
    let axis = direction.iamax();
    let largest = direction[axis].abs();
    if !(largest > 0.0) {
        return None;
    }
    let face = axis * 2 + usize::from(direction[axis] < 0.0);
    let along = |value: f64| (((value / largest + 1.0) * 0.5 * SIDE as f64) as usize).min(SIDE - 1);
    Some((face * SIDE + along(direction[(axis + 1) % 3])) * SIDE + along(direction[(axis + 2) % 3]))
}

/// Directions that count in one cell.
const MAX_IN_CELL: usize = 5;

/// How many these directions are, of each cell up to five: a façade that repeats itself has hundreds in a few.
pub(crate) fn spread<'d>(directions: impl Iterator<Item = &'d Vector3<f64>>) -> usize {
    let mut cells = [0; CELLS];
    for cell in directions.filter_map(cell) {
        cells[cell] = MAX_IN_CELL.min(cells[cell] + 1);
    }
    cells.iter().sum()
}

/// The unit vector through the middle of a cell.
pub(crate) fn centre(cell: usize) -> Vector3<f64> {
    let (face, row, column) = (cell / (SIDE * SIDE), cell / SIDE % SIDE, cell % SIDE);
    let axis = face / 2;
    let along = |step: usize| (step as f64 + 0.5) / SIDE as f64 * 2.0 - 1.0;
    let mut direction = Vector3::zeros();
    direction[axis] = if face.is_multiple_of(2) { 1.0 } else { -1.0 };
    direction[(axis + 1) % 3] = along(row);
    direction[(axis + 2) % 3] = along(column);
    direction.normalize()
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

    #[test]
    fn the_centre_of_a_cell_lies_in_it() {
        assert!((0..CELLS).all(|at| cell(&centre(at)) == Some(at)));
    }
}
