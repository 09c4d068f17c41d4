use super::{
    AUC_THRESHOLDS_DEG, Bounds, Calibration, DatasetFigures, JointReference, MethodFigures, NormalizedError,
    PoseError, SetFigures,
};
use crate::text::add;

/// Methods in the paper's order.
const METHODS: [&str; 3] = ["single", "camset", "camset+opt"];

/// The scene's figures and the paper's two tables in Markdown.
pub fn markdown_tables(figures: &DatasetFigures) -> String {
    let mut text = format!("# {}\n\n## Scene\n\n", figures.dataset);
    scene_table(&mut text, figures);
    if !figures.sets.is_empty() {
        text += "\n## Registration rate\n\nRegistered: has a pose and the verdict \"localized\". Apart: of these, in other components than the largest.\n\n| method |";
        for set in &figures.sets {
            add(&mut text, format_args!(" {} #reg./#total | rate |", set.name));
        }
        text += "\n|---|";
        text += &"---|---|".repeat(figures.sets.len());
        for method in METHODS {
            add(&mut text, format_args!("\n| {method} |"));
            for set in &figures.sets {
                let [registered, apart] =
                    set.methods.get(method).map_or([0; 2], |figures| [figures.registered, figures.apart]);
                let rate = 100.0 * registered as f64 / set.images.max(1) as f64;
                let apart = if apart > 0 { format!(" ({apart} apart)") } else { String::new() };
                add(&mut text, format_args!(" {registered}/{}{apart} | {rate:.2} % |", set.images));
            }
        }
        text += "\n\n## Location error (";
        match &figures.joint_reference {
            None => {
                text += "m / deg)\n\nOver the registered photos, after aligning each component of the scene to the truth by its images' centres (few or in a line: by their rotations, too).\n\n";
            }
            Some(joint) => joint_heading(&mut text, joint),
        }
        text += "| set | method | #reg./#total | min | median | max | mean | target |\n|---|---|---|---|---|---|---|---|\n";
        let units = figures.joint_reference.as_ref().map_or(1.0, JointReference::percent);
        for set in &figures.sets {
            for method in METHODS {
                if let Some(figures) = set.methods.get(method) {
                    error_row(&mut text, (set, method), figures, units);
                }
            }
        }
        calibration_table(&mut text, figures);
    }
    text += "\n## Time\n\n| stage | jobs run | from cache | wall s | CPU s |\n|---|---|---|---|---|\n";
    for stage in &figures.stages {
        let (ran, cached) = (stage.ran, stage.cached);
        add(
            &mut text,
            format_args!(
                "| {} | {ran} | {cached} | {:.2} | {:.2} |\n",
                stage.name, stage.wall_s, stage.cpu_s
            ),
        );
    }
    add(&mut text, format_args!("| all | | | {:.2} | {:.2} |\n\n", figures.wall_s, figures.cpu_s));
    add(&mut text, format_args!("Peak memory {:.0} MiB.\n", figures.peak_rss_mb));
    text
}

fn scene_table(text: &mut String, figures: &DatasetFigures) {
    let scene = &figures.scene;
    add(
        text,
        format_args!(
            "GPS: {}. Registered {}/{} images in the largest of {} components",
            figures.gps, scene.registered, scene.images, scene.components
        ),
    );
    add(text, format_args!(", {} points, {} observations", scene.points, scene.observations));
    if let Some(error) = scene.mean_angular_error_px {
        add(text, format_args!(", mean angular error {error:.3} px"));
    }
    *text += ".\n";
    if scene.misplaced > 0 {
        add(
            text,
            format_args!(
                "\n{} of these are misplaced: more than a twentieth of the extent from where the others say that they are. Everything is aligned without them; their errors count below.\n",
                scene.misplaced
            ),
        );
    }
    let rows = [
        ("position m", scene.position_m),
        ("rotation °", scene.rotation_deg),
        ("rotation ° (own alignment)", scene.rotation_own_deg),
        ("position m, as stated (one sigma)", scene.position_sigma_m),
        ("rotation °, as stated", scene.rotation_sigma_deg),
    ];
    if scene.position_m.is_some() {
        *text += "\n| error | median | mean | max |\n|---|---|---|---|\n";
        for (name, spread) in rows {
            if let Some(s) = spread {
                add(text, format_args!("| {name} | {:.4} | {:.4} | {:.4} |\n", s.median, s.mean, s.max));
            }
        }
    }
    if let Some(auc) = &scene.auc {
        let of_threshold = |threshold: f64| Some((threshold, auc.get(&threshold.to_string())?));
        let areas = AUC_THRESHOLDS_DEG.into_iter().filter_map(of_threshold);
        let parts: Vec<String> = areas.map(|(threshold, area)| format!("{threshold}° {area:.2}")).collect();
        add(text, format_args!("\nAUC of relative poses: {}\n", parts.join(", ")));
    }
    for skipped in &figures.skipped {
        add(text, format_args!("\nSkipped {}: {}\n", skipped.name, skipped.reason));
    }
    for (set, reason) in &figures.skipped_sets {
        add(text, format_args!("\nSkipped set {set}: {reason}\n"));
    }
    for warning in &figures.warnings {
        add(text, format_args!("\nWarning: {warning}\n"));
    }
}

/// What the location errors are against where there is no truth.
fn joint_heading(text: &mut String, joint: &JointReference) {
    let &JointReference { scene_images, photos, of_photos, .. } = joint;
    *text += "% of the scene's extent / deg)\n\n";
    add(
        text,
        format_args!(
            "No truth: against a reconstruction of scene and photos together, which holds {photos} of {of_photos} photos beside {scene_images} images of the scene"
        ),
    );
    *text += if joint.is_usable() {
        ". Over the registered photos, after aligning each component of the scene to it; how far both are off it does not tell.\n\n"
    } else {
        ": too few to compare with.\n\n"
    };
}

/// `units` are those of the table in one of the errors.
fn error_row(text: &mut String, (set, method): (&SetFigures, &str), figures: &MethodFigures, units: f64) {
    add(text, format_args!("| {} | {method} | {}/{} |", set.name, figures.registered, set.images));
    let parts: [fn(&Bounds) -> f64; 4] = [|b| b.min, |b| b.median, |b| b.max, |b| b.mean];
    for part in parts {
        match figures.position_m.as_ref().zip(figures.rotation_deg.as_ref()) {
            Some((position, rotation)) => {
                add(text, format_args!(" {:.3}/{:.3} |", units * part(position), part(rotation)));
            }
            None => *text += " - |",
        }
    }
    match figures.target {
        Some(PoseError { position_m, rotation_deg }) => {
            add(text, format_args!(" {:.3}/{rotation_deg:.3} |\n", units * position_m));
        }
        None if figures.target_registered => *text += " registered |\n",
        None => *text += " - |\n",
    }
}

/// How the registered photos' covariances compare with their errors.
fn calibration_table(text: &mut String, figures: &DatasetFigures) {
    let of_method =
        |set: &SetFigures, method| set.methods.get(method).and_then(|figures| figures.calibration);
    let rows: Vec<(&str, &str, Calibration)> = (figures.sets.iter())
        .flat_map(|set| METHODS.map(|method| Some((set.name.as_str(), method, of_method(set, method)?))))
        .flatten()
        .collect();
    if rows.is_empty() {
        return;
    }
    let whose =
        if figures.joint_reference.is_some() { "centre in the joint reconstruction" } else { "true centre" };
    add(
        text,
        format_args!(
            "\n## Stated uncertainty\n\nRegistered photos whose {whose} lies in the stated 95 % ellipsoid, and mean squared error per coordinate in what\nthe covariance states (1 where it states the truth).\n\n"
        ),
    );
    *text += "| set | method | within 95 % | centre | rotation |\n|---|---|---|---|---|\n";
    for (set, method, Calibration { photos, within_95, mean }) in rows {
        let NormalizedError { position, rotation } = mean;
        add(
            text,
            format_args!("| {set} | {method} | {within_95}/{photos} | {position:.2} | {rotation:.2} |\n"),
        );
    }
}

/// One line an image and method. The last columns are the squared errors per coordinate in what the covariance states, and
/// the component of the scene, 0 the largest.
pub fn errors_csv(figures: &DatasetFigures) -> String {
    let mut text = String::from(
        "set,method,name,position_m,rotation_deg,verdict,inliers,reasons,normalized_position,normalized_rotation,component\n",
    );
    for (name, error) in &figures.scene_errors {
        add(&mut text, format_args!(",scene,{name},{},{},,,,,,0\n", error.position_m, error.rotation_deg));
    }
    for set in &figures.sets {
        for (method, of_method) in &set.methods {
            for photo in &of_method.answers {
                let error = of_method.errors.get(&photo.name);
                let error = error.map_or(",".to_owned(), |e| format!("{},{}", e.position_m, e.rotation_deg));
                let normalized = of_method.normalized.get(&photo.name);
                let normalized =
                    normalized.map_or(",".to_owned(), |e| format!("{},{}", e.position, e.rotation));
                let (verdict, inliers) = (photo.verdict, photo.inliers);
                let reasons = photo.reasons.join("; ").replace('"', "'");
                add(
                    &mut text,
                    format_args!(
                        "{},{method},{},{error},{verdict:?},{inliers},\"{reasons}\",{normalized},{}\n",
                        set.name, photo.name, photo.component
                    ),
                );
            }
        }
    }
    text
}
