//! Dependencies run one way, and what only the orchestrator may use is used there only.

#![allow(clippy::unwrap_used, reason = "the helpers of tests, too, may fail by panicking")]

use std::collections::BTreeMap;

use cargo_metadata::{DependencyKind, MetadataCommand};

/// Package to its normal dependencies.
fn edges() -> BTreeMap<String, Vec<String>> {
    let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml");
    let metadata = MetadataCommand::new().manifest_path(manifest).no_deps().exec().unwrap();
    let normal = |package: &cargo_metadata::Package| {
        let normal =
            package.dependencies.iter().filter(|dependency| dependency.kind == DependencyKind::Normal);
        normal.map(|dependency| dependency.name.clone()).collect()
    };
    metadata.packages.iter().map(|package| (package.name.to_string(), normal(package))).collect()
}

#[test]
fn crates_depend_only_on_those_before_them() {
    let order = ["setloc-features", "setloc-sfm", "setloc-index", "setloc-camset", "setloc-orchestrator"];
    let edges = edges();
    for (at, name) in order.iter().enumerate() {
        for dependency in edges[*name].iter().filter(|dependency| order.contains(&dependency.as_str())) {
            assert!(order[..at].contains(&dependency.as_str()), "{name} must not depend on {dependency}");
        }
        if at > 0 {
            assert!(edges[*name].contains(&order[at - 1].to_owned()), "{name} builds on {}", order[at - 1]);
        }
    }
    assert!(edges["setloc-town"].iter().all(|name| !order[1..].contains(&name.as_str())));
}

#[test]
fn files_terminal_and_graph_belong_to_the_orchestrator() {
    let reserved = ["bincode", "clap", "petgraph", "indicatif", "anyhow", "ctrlc", "toml", "tempfile"];
    for (name, dependencies) in edges().iter().filter(|(name, _)| *name != "setloc-orchestrator") {
        let found: Vec<_> =
            dependencies.iter().filter(|dependency| reserved.contains(&dependency.as_str())).collect();
        assert!(found.is_empty(), "{name} must not depend on {found:?}");
    }
    let opencv: Vec<_> =
        edges().into_iter().filter(|(_, d)| d.contains(&"opencv".to_owned())).map(|(n, _)| n).collect();
    assert_eq!(opencv, ["setloc-features"]);
}
