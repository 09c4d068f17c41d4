//! The artifact file format: the only place that knows `bincode`.
//!
//! Layout, little-endian: magic (8 bytes), schema (u32), kind length (u16) and kind (UTF-8), payload length (u64),
//! BLAKE3 of the payload (32 bytes), payload. The payload is the artifact in bincode's standard configuration; large
//! arrays are raw blocks inside it (see [`crate::artifacts`]).

use serde::{Serialize, de::DeserializeOwned};

const MAGIC: &[u8; 8] = b"SETLOC\r\n";

/// A value that can be stored and shared between jobs.
pub trait Artifact: Send + Sync + Sized + 'static {
    /// Name of the type in files.
    const KIND: &'static str;
    /// Version of the layout; one more for each incompatible change.
    const SCHEMA: u32;

    /// Appends the payload.
    ///
    /// # Errors
    /// [`CodecError::Encode`] when a value cannot be written.
    fn write_payload(&self, file: &mut Vec<u8>) -> Result<(), CodecError>;

    /// The value of a payload.
    ///
    /// # Errors
    /// [`CodecError::Payload`] when the bytes are not such a value.
    fn from_payload(payload: &[u8]) -> Result<Self, CodecError>;
}

/// Implements [`Artifact`] by serde for types without large arrays.
#[macro_export]
macro_rules! serde_artifact {
    ($type:ty, $kind:literal, $schema:literal) => {
        impl $crate::codec::Artifact for $type {
            const KIND: &'static str = $kind;
            const SCHEMA: u32 = $schema;

            fn write_payload(&self, file: &mut Vec<u8>) -> Result<(), $crate::codec::CodecError> {
                $crate::codec::write_bytes(self, file)
            }

            fn from_payload(payload: &[u8]) -> Result<Self, $crate::codec::CodecError> {
                $crate::codec::from_bytes(payload)
            }
        }
    };
}

/// Why bytes are not the expected artifact.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CodecError {
    /// The bytes do not begin as an artifact does, or end too early.
    #[error("not a setloc artifact: {0}")]
    Header(&'static str),
    /// Another kind of artifact.
    #[error("this is a `{got}` artifact, expected `{expected}`")]
    Kind {
        /// Kind wanted.
        expected: &'static str,
        /// Kind found.
        got: String,
    },
    /// Written by another version.
    #[error("`{kind}` artifact has schema {got}, this program reads schema {expected}")]
    Schema {
        /// Kind of the artifact.
        kind: &'static str,
        /// Schema this program reads.
        expected: u32,
        /// Schema found.
        got: u32,
    },
    /// The payload is damaged.
    #[error("`{0}` artifact is damaged: its checksum does not match")]
    Checksum(&'static str),
    /// The value cannot be written.
    #[error("cannot encode: {0}")]
    Encode(String),
    /// The payload cannot be read although its checksum matches.
    #[error("cannot decode: {0}")]
    Payload(String),
}

/// Appends to what is there.
struct Appended<'v>(&'v mut Vec<u8>);

impl bincode::enc::write::Writer for Appended<'_> {
    #[inline]
    fn write(&mut self, bytes: &[u8]) -> Result<(), bincode::error::EncodeError> {
        self.0.extend_from_slice(bytes);
        Ok(())
    }
}

/// Appends a serde value.
///
/// # Errors
/// [`CodecError::Encode`] when a value cannot be written.
pub fn write_bytes<T: Serialize>(value: &T, to: &mut Vec<u8>) -> Result<(), CodecError> {
    bincode::serde::encode_into_writer(value, Appended(to), bincode::config::standard())
        .map_err(|e| CodecError::Encode(e.to_string()))
}

/// Bytes to serde value; all bytes must be used.
///
/// # Errors
/// [`CodecError::Payload`] when the bytes are not such a value.
pub fn from_bytes<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    let (value, used) = bincode::serde::decode_from_slice(bytes, bincode::config::standard())
        .map_err(|e| CodecError::Payload(e.to_string()))?;
    if used == bytes.len() {
        Ok(value)
    } else {
        Err(CodecError::Payload(format!("{} bytes left over", bytes.len() - used)))
    }
}

/// The whole file of an artifact.
///
/// # Errors
/// [`CodecError::Encode`] when a value cannot be written.
pub fn encode<T: Artifact>(value: &T) -> Result<Vec<u8>, CodecError> {
    let mut file = Vec::new();
    file.extend_from_slice(MAGIC);
    file.extend_from_slice(&T::SCHEMA.to_le_bytes());
    file.extend_from_slice(&(T::KIND.len() as u16).to_le_bytes());
    file.extend_from_slice(T::KIND.as_bytes());
    // What these say is known once the payload is there; it is not written elsewhere first, tens of megabytes as it is.
    let length_at = file.len();
    file.extend_from_slice(&[0; 8 + 32]);
    let (checksum_at, payload_at) = (length_at + 8, file.len());
    value.write_payload(&mut file)?;
    let length = (file.len() - payload_at) as u64;
    let checksum = blake3::hash(&file[payload_at..]);
    file[length_at..checksum_at].copy_from_slice(&length.to_le_bytes());
    file[checksum_at..payload_at].copy_from_slice(checksum.as_bytes());
    Ok(file)
}

/// The value in an artifact file, its checksum verified first.
///
/// # Errors
/// Every variant of [`CodecError`] but `Encode`.
pub fn decode<T: Artifact>(file: &[u8]) -> Result<T, CodecError> {
    let Parts { kind, schema, checksum, payload } = split(file)?;
    if kind != T::KIND.as_bytes() {
        return Err(CodecError::Kind { expected: T::KIND, got: String::from_utf8_lossy(kind).into_owned() });
    }
    if schema != T::SCHEMA {
        return Err(CodecError::Schema { kind: T::KIND, expected: T::SCHEMA, got: schema });
    }
    if blake3::hash(payload).as_bytes() != checksum {
        return Err(CodecError::Checksum(T::KIND));
    }
    T::from_payload(payload)
}

/// The parts of an artifact file.
struct Parts<'f> {
    kind: &'f [u8],
    schema: u32,
    checksum: &'f [u8],
    payload: &'f [u8],
}

fn split(file: &[u8]) -> Result<Parts<'_>, CodecError> {
    let mut rest = file;
    let mut take = |count: usize| {
        let (head, tail) =
            rest.split_at_checked(count).ok_or(CodecError::Header("it ends within its header"))?;
        rest = tail;
        Ok::<_, CodecError>(head)
    };
    if take(8)? != MAGIC {
        return Err(CodecError::Header("its first bytes are those of another format"));
    }
    let number = |bytes: &[u8]| bytes.iter().rev().fold(0_u64, |sum, &byte| (sum << 8) | u64::from(byte));
    let schema = number(take(4)?) as u32;
    let kind_length = number(take(2)?) as usize;
    let kind = take(kind_length)?;
    let length = number(take(8)?);
    let checksum = take(32)?;
    if rest.len() as u64 != length {
        return Err(CodecError::Header("its length is not the stated one (truncated?)"));
    }
    Ok(Parts { kind, schema, checksum, payload: rest })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, serde::Serialize, serde::Deserialize)]
    struct Sample(Vec<u32>);
    serde_artifact!(Sample, "sample", 3);

    #[test]
    fn gives_back_what_it_was_given() {
        let value = Sample(vec![1, 2, 70_000]);
        assert_eq!(decode::<Sample>(&encode(&value).unwrap()).unwrap(), value);
    }

    #[test]
    fn every_flipped_bit_and_every_truncation_is_refused() {
        let file = encode(&Sample(vec![5, 6, 7])).unwrap();
        for at in 0..file.len() {
            let mut damaged = file.clone();
            damaged[at] ^= 0x10;
            assert!(decode::<Sample>(&damaged).is_err(), "flip at byte {at}");
            assert!(decode::<Sample>(&file[..at]).is_err(), "cut at byte {at}");
        }
    }
}
