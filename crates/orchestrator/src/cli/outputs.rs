//! Outputs that would damage what a command reads, refused before anything runs.

use std::path::{Path, PathBuf};

use anyhow::Result;

use crate::error::Hinted;

/// The only image that is written into a folder of results itself.
pub const PICTURE: &str = "top_view.png";

/// The page that `report` makes of a folder of results, which a run that writes these anew removes.
pub const PAGE: &str = "report.html";

/// Refuses a file to be written that is one of those that are read, by whatever path it is named.
pub fn refuse_input<'p>(inputs: impl IntoIterator<Item = &'p Path>, output: &Path) -> Result<()> {
    let Ok(output_at) = output.canonicalize() else { return Ok(()) };
    let is_output = |input: &&Path| input.canonicalize().is_ok_and(|input| input == output_at);
    match inputs.into_iter().find(is_output) {
        Some(input) => Err(Hinted::error(
            format!("{} is read, and would be replaced by what is written", input.display()),
            "name another output",
        )),
        None => Ok(()),
    }
}

/// Refuses a file to be written that is there with another content: a data set may have one of its own under that name.
pub fn refuse_other_content(output: &Path, content: &[u8]) -> Result<()> {
    match std::fs::read(output) {
        Ok(present) if present != content => Err(Hinted::error(
            format!("{} is there already, and not what would be written", output.display()),
            "name another folder with -o, or remove the file",
        )),
        _ => Ok(()),
    }
}

/// Refuses a folder where `option` names a file to be written; `example` is a file's name.
pub fn refuse_folder(option: &str, output: &Path, example: &str) -> Result<()> {
    let ends_open = output.as_os_str().as_encoded_bytes().ends_with(b"/");
    if !output.is_dir() && !ends_open && output.file_name().is_some() {
        return Ok(());
    }
    let hint = format!("name a file in it: {option} {}", output.join(example).display());
    Err(Hinted::error(format!("{} is a folder, and a file is to be written", output.display()), hint))
}

/// Refuses a folder for results among the images that are given: the next run would read the results as images.
pub fn refuse_image_folder(images: &[PathBuf], results: &Path, hint: &str) -> Result<()> {
    let is_same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    let picture = results.join(PICTURE);
    let is_results = |input: &&PathBuf| is_same(input, results) || is_same(input, &picture);
    match images.iter().find(is_results) {
        Some(input) => Err(Hinted::error(
            format!("the results would go into {}, among the images", results_in(input).display()),
            hint,
        )),
        None => Ok(()),
    }
}

/// Refuses a folder into which other results of the same command go: both write `poses.json`.
pub fn refuse_same_folder(results: &Path, others: &Path, hint: &str) -> Result<()> {
    if std::path::absolute(results)? != std::path::absolute(others)? {
        return Ok(());
    }
    Err(Hinted::error(format!("{} would hold the results of both", results.display()), hint))
}

/// The folder that is given, or that a given file is in.
fn results_in(input: &Path) -> &Path {
    if input.is_dir() { input } else { input.parent().unwrap_or(input) }
}

#[cfg(test)]
mod tests {
    use std::slice;

    use super::*;

    #[test]
    fn results_among_the_images_are_refused() {
        let root = tempfile::tempdir().unwrap();
        let street = root.path().join("street");
        std::fs::create_dir(&street).unwrap();
        let refuse = |images: &[PathBuf], results: &Path| refuse_image_folder(images, results, "elsewhere");
        let refused = refuse(slice::from_ref(&street), &root.path().join("street/../street"));
        let text = format!("{:#}", refused.unwrap_err());
        assert!(text.contains("street") && text.contains("among the images"), "{text}");
        refuse(slice::from_ref(&street), &street.join("exports")).unwrap();
        refuse(slice::from_ref(&street), root.path()).unwrap();
        let (photo, picture) = (street.join("a.jpg"), street.join("top_view.png"));
        std::fs::write(&photo, "").unwrap();
        std::fs::write(&picture, "").unwrap();
        refuse(slice::from_ref(&photo), &street).unwrap();
        assert!(refuse(&[photo, picture], &street).is_err());
    }

    #[test]
    fn a_folder_of_other_results_is_refused_whether_it_is_there_or_not() {
        let refuse = |a: &str, b: &str| refuse_same_folder(Path::new(a), Path::new(b), "elsewhere");
        assert!(refuse("out", "./out/").is_err());
        refuse("out", "out2").unwrap();
    }

    #[test]
    fn a_folder_is_no_file_whether_it_is_there_or_not() {
        let root = tempfile::tempdir().unwrap();
        for output in [root.path().to_owned(), root.path().join("new/"), root.path().join("..")] {
            let error = refuse_folder("-o", &output, "scene.setloc").unwrap_err();
            let hint = error.downcast_ref::<Hinted>().unwrap().hint();
            assert_eq!(hint, format!("name a file in it: -o {}", output.join("scene.setloc").display()));
        }
        refuse_folder("-o", &root.path().join("new"), "scene.setloc").unwrap();
    }

    #[test]
    fn a_file_with_another_content_is_refused_and_the_same_one_not() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("truth.json");
        refuse_other_content(&file, b"new").unwrap();
        std::fs::write(&file, "new").unwrap();
        refuse_other_content(&file, b"new").unwrap();
        let error = refuse_other_content(&file, b"newer").unwrap_err();
        assert!(error.to_string().contains("truth.json is there already"), "{error}");
    }

    #[test]
    fn a_file_that_is_read_is_refused_by_any_path() {
        let root = tempfile::tempdir().unwrap();
        let (file, link) = (root.path().join("s.setloc"), root.path().join("l.setloc"));
        std::fs::write(&file, "").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        for output in [&file, &link, &root.path().join("./s.setloc")] {
            let text = refuse_input([file.as_path()], output).unwrap_err().to_string();
            assert!(text.contains("s.setloc is read, and would be replaced"), "{text}");
        }
        refuse_input([file.as_path()], &root.path().join("t.setloc")).unwrap();
    }
}
