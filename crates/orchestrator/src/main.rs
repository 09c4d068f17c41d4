//! The `setloc` program.
fn main() {}
