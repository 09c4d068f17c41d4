/// Most names of images in a line.
pub const MOST_NAMED: usize = 20;

/// The first of some names in a line, and how many more there are.
pub fn listed(names: &[impl AsRef<str>], most: usize) -> String {
    let (named, rest) = names.split_at(names.len().min(most));
    let named: Vec<&str> = named.iter().map(AsRef::as_ref).collect();
    let others = match rest.len() {
        0 => String::new(),
        1 => " and 1 other".to_owned(),
        more => format!(" and {more} others"),
    };
    named.join(", ") + &others
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_of_names_are_cut() {
        let names: Vec<String> = (0..23).map(|number| format!("{number}.jpg")).collect();
        assert_eq!(listed(&names[..2], MOST_NAMED), "0.jpg, 1.jpg");
        assert_eq!(listed(&names[..3], 2), "0.jpg, 1.jpg and 1 other");
        assert!(listed(&names, MOST_NAMED).ends_with("18.jpg, 19.jpg and 3 others"));
    }
}
