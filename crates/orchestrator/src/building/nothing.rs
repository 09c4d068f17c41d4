use std::collections::BTreeSet;

use anyhow::Result;
use setloc_features::ImageFeatures;
use setloc_sfm::MapperOutput;

use super::MIN_KEYPOINTS;
use crate::artifacts::LeftApart;
use crate::dataset::SourceImage;
use crate::graph::Executor;
use crate::jobs::SceneJobs;
use crate::text::some_of;

/// Why no image of a scene is registered, and what to do about it; `None` where some are.
///
/// # Errors
/// When what tells it can neither be read nor made again.
pub(super) fn why_nothing(
    executor: &Executor<'_>,
    jobs: &SceneJobs,
    images: &[SourceImage],
) -> Result<Option<String>> {
    let left = executor.load_made::<LeftApart>(jobs.apart.job)?;
    if left.is_none_or(|left| left.known_pairs > 0) {
        return Ok(None);
    }
    let mut usable = Vec::new();
    for (image, job) in images.iter().zip(&jobs.features) {
        if let Some(features) = executor.load_made::<ImageFeatures>(*job)? {
            usable.push((image, features.len()));
        }
    }
    let model = executor.load_made::<MapperOutput>(jobs.model)?;
    let verified = model.map_or(0, |model| model.open_pairs.len());
    Ok(Some(format!("no image is registered: {}", reason(&usable, verified))))
}

/// By the usable images, each with its number of keypoints, and the number of pairs that were verified.
fn reason(usable: &[(&SourceImage, usize)], verified: usize) -> String {
    let contents: BTreeSet<_> = usable.iter().map(|(image, _)| image.hash).collect();
    if usable.len() < 2 {
        return "a scene takes two images at least, and one alone is usable; give more (panoramas 3 to 10 m apart)".to_owned();
    }
    if contents.len() < 2 {
        return format!("all {} images have the same content; give images of other places", usable.len());
    }
    let is_blank = |(_, keypoints): &&(&SourceImage, usize)| *keypoints < MIN_KEYPOINTS;
    let blank: Vec<String> = (usable.iter().filter(is_blank))
        .map(|(image, keypoints)| format!("{} ({keypoints} keypoints)", image.name))
        .collect();
    if usable.len() - blank.len() < 2 {
        return format!(
            "next to nothing is found in images that are dark, blurred, blank or masked: {}",
            some_of(&blank, "images")
        );
    }
    let beside = match blank.len() {
        0 => String::new(),
        _ => format!("; next to nothing is found in {}", some_of(&blank, "images")),
    };
    match verified {
        0 => format!(
            "no two images share enough of what they show; take them closer to each other (panoramas 3 to 10 m){beside}"
        ),
        1 => format!(
            "one pair of images matches, which holds no model; take more images between and beside them{beside}"
        ),
        pairs => format!(
            "{pairs} pairs of images match, and hold no model: they were turned on the spot, or no third image confirms them; take more images between them, each some metres from the next{beside}"
        ),
    }
}

#[cfg(test)]
mod tests {
    use setloc_features::Camera;

    use super::*;

    #[test]
    fn the_first_reason_that_explains_it_is_told() {
        let image = |name: &str| SourceImage::guessed(name, Camera::equirectangular(64, 32));
        let (a, b, c) = (image("a"), image("b"), image("c"));
        let copy = SourceImage { name: "copy".to_owned(), ..a.clone() };
        assert!(reason(&[(&a, 900)], 0).contains("one alone is usable"));
        assert!(reason(&[(&a, 900), (&copy, 900)], 0).starts_with("all 2 images have the same content"));
        let dark = reason(&[(&a, 3), (&b, 900)], 0);
        assert!(dark.ends_with("blank or masked: a (3 keypoints)"), "{dark}");
        let apart = reason(&[(&a, 900), (&b, 900)], 0);
        assert!(apart.ends_with("closer to each other (panoramas 3 to 10 m)"), "{apart}");
        let both = reason(&[(&a, 900), (&b, 900), (&c, 0)], 0);
        assert!(
            both.starts_with("no two images share") && both.ends_with("found in c (0 keypoints)"),
            "{both}"
        );
        assert!(reason(&[(&a, 900), (&b, 900)], 1).starts_with("one pair of images matches"));
        assert!(reason(&[(&a, 900), (&b, 900), (&c, 900)], 3).starts_with("3 pairs of images match"));
    }
}
