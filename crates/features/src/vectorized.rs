//! Compiles plain loops for the vector registers that the processor has.

/// Which instructions loops may use: what the processor was found to have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Level(Instructions);

/// What a [`Level`] stands for. Public for [`vectorized!`](crate::vectorized!) in other crates, which matches on it; a
/// level cannot be made of it.
#[doc(hidden)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Instructions {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// With the multiply-accumulate of small integers.
    #[cfg(target_arch = "x86_64")]
    Avx512Vnni,
}

impl Level {
    /// What every processor has.
    pub const BASELINE: Self = Self(Instructions::Baseline);

    /// The fastest of this processor.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if let Some(best) = Self::vectors().into_iter().flatten().next() {
            return best;
        }
        Self::BASELINE
    }

    /// All that this processor has, for tests that they agree.
    pub fn all() -> Vec<Self> {
        #[cfg(target_arch = "x86_64")]
        let vectors = Self::vectors().into_iter().flatten();
        #[cfg(not(target_arch = "x86_64"))]
        let vectors = std::iter::empty();
        vectors.chain([Self::BASELINE]).collect()
    }

    /// The fastest first.
    #[cfg(target_arch = "x86_64")]
    fn vectors() -> [Option<Self>; 3] {
        use std::arch::is_x86_feature_detected as has;
        let avx512 = has!("avx512f") && has!("avx512bw") && has!("avx512dq") && has!("avx512vl");
        let if_there = |is_there: bool, instructions| is_there.then_some(Self(instructions));
        [
            if_there(avx512 && has!("avx512vnni"), Instructions::Avx512Vnni),
            if_there(avx512, Instructions::Avx512),
            if_there(has!("avx2"), Instructions::Avx2),
        ]
    }

    #[doc(hidden)]
    pub fn instructions(self) -> Instructions {
        self.0
    }
}

/// Defines a function whose body is compiled once for each [`Level`](crate::vectorized::Level).
///
/// The level comes before the function's own arguments.
///
/// The body is ordinary Rust without fused operations or reassociation, so every level gives the same bits. It should be
/// `for` loops: what closures given to `map` or `sum` do may stay a call, compiled for the baseline.
#[macro_export]
macro_rules! vectorized {
    ($(#[$doc:meta])* $visibility:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)? $body:block) => {
        $(#[$doc])*
        $visibility fn $name(level: $crate::vectorized::Level, $($argument: $type),*) $(-> $result)? {
            #[inline(always)]
            fn body($($argument: $type),*) $(-> $result)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2($($argument: $type),*) $(-> $result)? {
                body($($argument),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
            fn avx512($($argument: $type),*) $(-> $result)? {
                body($($argument),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
            fn avx512vnni($($argument: $type),*) $(-> $result)? {
                body($($argument),*)
            }
            match level.instructions() {
                $crate::vectorized::Instructions::Baseline => body($($argument),*),
                // SAFETY: a level is only made by detecting its instructions.
                #[cfg(target_arch = "x86_64")]
                $crate::vectorized::Instructions::Avx2 => unsafe { avx2($($argument),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::vectorized::Instructions::Avx512 => unsafe { avx512($($argument),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::vectorized::Instructions::Avx512Vnni => unsafe { avx512vnni($($argument),*) },
            }
        }
    };
}
