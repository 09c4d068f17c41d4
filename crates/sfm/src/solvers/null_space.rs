use nalgebra::SVector;

/// Orthonormal basis of the `K` = `N` − `M` dimensions orthogonal to `M` vectors, by Householder reflections.
///
/// Where the vectors are dependent the basis is an arbitrary part of the larger null space.
#[inline]
pub(super) fn null_space<const M: usize, const N: usize, const K: usize>(
    mut vectors: [[f64; N]; M],
) -> [SVector<f64, N>; K] {
    const { assert!(M + K == N) };
    let mut beta = [0.0; M];
    for k in 0..M {
        let norm = vectors[k][k..].iter().map(|v| v * v).sum::<f64>().sqrt();
        vectors[k][k] += norm.copysign(vectors[k][k]);
        let square = vectors[k][k..].iter().map(|v| v * v).sum::<f64>();
        beta[k] = if square > 0.0 { 2.0 / square } else { 0.0 };
        let reflector = vectors[k];
        for other in &mut vectors[k + 1..] {
            let dot = (k..N).map(|i| reflector[i] * other[i]).sum::<f64>() * beta[k];
            for i in k..N {
                other[i] -= dot * reflector[i];
            }
        }
    }
    std::array::from_fn(|n| {
        let mut basis = SVector::<f64, N>::zeros();
        basis[M + n] = 1.0;
        for k in (0..M).rev() {
            let dot = (k..N).map(|i| vectors[k][i] * basis[i]).sum::<f64>() * beta[k];
            for i in k..N {
                basis[i] -= dot * vectors[k][i];
            }
        }
        basis
    })
}
