//! What a job's result depends on, as readable JSON; its hash is the cache key.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// BLAKE3 of some bytes, shown as 64 hexadecimal digits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ContentHash([u8; 32]);

impl ContentHash {
    /// The hash of `bytes`.
    pub fn of(bytes: &[u8]) -> Self {
        Self(*blake3::hash(bytes).as_bytes())
    }

    /// One hash for several, in their order.
    pub fn of_all(hashes: &[Self]) -> Self {
        Self::of(&hashes.iter().flat_map(|hash| hash.0).collect::<Vec<u8>>())
    }

    /// The first eight bytes as a number, for seeds.
    pub fn seed(self) -> u64 {
        self.0[..8].iter().fold(0, |sum, &byte| (sum << 8) | u64::from(byte))
    }
}

impl fmt::Display for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl From<ContentHash> for String {
    fn from(hash: ContentHash) -> Self {
        hash.to_string()
    }
}

impl TryFrom<String> for ContentHash {
    type Error = String;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        blake3::Hash::from_hex(&text)
            .map(|hash| Self(*hash.as_bytes()))
            .map_err(|e| format!("`{text}` is no content hash: {e}"))
    }
}

/// Everything a job's output is a function of.
///
/// No path, no time and no thread count is in it, so a store can be moved to another place or machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fingerprint {
    /// Kind of job, as `features` or `verify`.
    pub kind: String,
    /// Version of the code behind this kind.
    pub version: u32,
    /// The job's own parameters, and nothing else's.
    pub params: Value,
    /// Content of each input by its role.
    pub inputs: BTreeMap<String, ContentHash>,
}

impl Fingerprint {
    /// The cache key: the hash of the JSON text with sorted keys.
    pub fn key(&self) -> ContentHash {
        ContentHash::of(self.to_json().to_string().as_bytes())
    }

    /// As JSON; object keys are sorted.
    pub fn to_json(&self) -> Value {
        serde_json::json!({ "kind": self.kind, "version": self.version, "params": self.params, "inputs": self.inputs })
    }

    /// What differs from `before`, one sentence a field.
    pub fn changes_since(&self, before: &Self) -> Vec<String> {
        let mut changes = Vec::new();
        if self.version != before.version {
            changes.push(format!(
                "the code of `{}` changed from version {} to {}",
                self.kind, before.version, self.version
            ));
        }
        diff_values("", &before.params, &self.params, &mut changes);
        for (role, hash) in &self.inputs {
            match before.inputs.get(role) {
                None => changes.push(format!("input {role} is new")),
                Some(old) if old != hash => changes.push(format!("the content of input {role} changed")),
                Some(_) => {}
            }
        }
        for role in before.inputs.keys().filter(|role| !self.inputs.contains_key(*role)) {
            changes.push(format!("input {role} is gone"));
        }
        changes
    }
}

/// Compares two parameter trees; `name` is the dotted name so far.
fn diff_values(name: &str, before: &Value, now: &Value, changes: &mut Vec<String>) {
    let child = |key: &str| if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
    if let (Value::Object(old), Value::Object(new)) = (before, now) {
        for (key, value) in new {
            match old.get(key) {
                Some(was) => diff_values(&child(key), was, value, changes),
                None => changes.push(format!("parameter {} is new: {value}", child(key))),
            }
        }
        for key in old.keys().filter(|key| !new.contains_key(*key)) {
            changes.push(format!("parameter {} is gone", child(key)));
        }
    } else if before != now {
        changes.push(format!("parameter {name} changed from {before} to {now}"));
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn sample(params: Value) -> Fingerprint {
        let inputs = BTreeMap::from([("image".to_owned(), ContentHash::of(b"pixels"))]);
        Fingerprint { kind: "features".to_owned(), version: 1, params, inputs }
    }

    #[test]
    fn key_does_not_depend_on_the_order_of_parameters() {
        let a: Value = serde_json::from_str(r#"{"x": 1, "y": 2}"#).unwrap();
        let b: Value = serde_json::from_str(r#"{"y": 2, "x": 1}"#).unwrap();
        assert_eq!(sample(a).key(), sample(b).key());
    }

    #[test]
    fn names_the_changed_parameter() {
        let before = sample(json!({"sift": {"max": 10, "edge": 1}}));
        let now = sample(json!({"sift": {"max": 20, "edge": 1}}));
        assert_eq!(now.changes_since(&before), ["parameter sift.max changed from 10 to 20"]);
        assert_ne!(now.key(), before.key());
    }

    #[test]
    fn hash_reads_back_from_its_text() {
        let hash = ContentHash::of(b"a");
        assert_eq!(ContentHash::try_from(hash.to_string()).unwrap(), hash);
        assert!(ContentHash::try_from("xy".to_owned()).is_err());
    }
}
