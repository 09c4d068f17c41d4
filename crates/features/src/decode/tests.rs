use std::io::Cursor;

use image::{ExtendedColorType, ImageEncoder, ImageFormat};

use super::*;
use crate::{Camera, CameraModel};

/// A picture without symmetry: red grows to the right, green downwards.
fn picture(width: u32, height: u32) -> Vec<u8> {
    (0..height)
        .flat_map(|y| (0..width).flat_map(move |x| [(x * 255 / width) as u8, (y * 255 / height) as u8, 40]))
        .collect()
}

fn encode(format: ImageFormat, width: u32, height: u32) -> Vec<u8> {
    let image = image::RgbImage::from_raw(width, height, picture(width, height)).unwrap();
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

/// A JPEG with one APP1 segment behind its start.
fn with_app1(jpeg: &[u8], payload: &[u8]) -> Vec<u8> {
    let length = (payload.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], &[0xFF, 0xE1], &length, payload, &jpeg[2..]].concat()
}

/// EXIF of one IFD: (tag, type, value) with types SHORT 3 and RATIONAL 5, ASCII 2 of at most 4 bytes.
fn exif(main: &[(u16, u16, &[u32])], sub: &[(u16, u16, &[u32])], gps: &[(u16, u16, &[u32])]) -> Vec<u8> {
    let mut tiff = b"II\x2a\0\x08\0\0\0".to_vec();
    let pointers = usize::from(!sub.is_empty()) + usize::from(!gps.is_empty());
    let size = |entries: usize, values: &[(u16, u16, &[u32])]| -> u32 {
        let data: usize = values.iter().filter(|entry| entry.1 == 5).map(|entry| entry.2.len() * 4).sum();
        (2 + entries * 12 + 4 + data) as u32
    };
    let sub_at = 8 + size(main.len() + pointers, main);
    let gps_at = sub_at + if sub.is_empty() { 0 } else { size(sub.len(), sub) };
    let mut head: Vec<(u16, u16, Vec<u32>)> =
        main.iter().map(|entry| (entry.0, entry.1, entry.2.to_vec())).collect();
    if !sub.is_empty() {
        head.push((0x8769, 4, vec![sub_at]));
    }
    if !gps.is_empty() {
        head.push((0x8825, 4, vec![gps_at]));
    }
    let owned =
        |values: &[(u16, u16, &[u32])]| values.iter().map(|e| (e.0, e.1, e.2.to_vec())).collect::<Vec<_>>();
    for ifd in [head, owned(sub), owned(gps)] {
        if ifd.is_empty() {
            continue;
        }
        let mut data_at = tiff.len() + 2 + ifd.len() * 12 + 4;
        let mut data = Vec::new();
        tiff.extend((ifd.len() as u16).to_le_bytes());
        for (tag, kind, values) in &ifd {
            tiff.extend(tag.to_le_bytes());
            tiff.extend(kind.to_le_bytes());
            if *kind == 5 {
                tiff.extend((values.len() as u32 / 2).to_le_bytes());
                tiff.extend((data_at as u32).to_le_bytes());
                data_at += values.len() * 4;
                for value in values {
                    data.extend(value.to_le_bytes());
                }
            } else {
                tiff.extend((if *kind == 2 { 2u32 } else { 1 }).to_le_bytes());
                tiff.extend(values[0].to_le_bytes());
            }
        }
        tiff.extend([0; 4]);
        tiff.extend(data);
    }
    [b"Exif\0\0".as_slice(), &tiff].concat()
}

fn limits() -> DecodeLimits {
    DecodeLimits::default()
}

#[test]
fn all_formats_decode_to_the_same_picture() {
    for format in
        [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP, ImageFormat::Bmp]
    {
        let bytes = encode(format, 60, 40);
        let image = decode(&bytes, &limits()).unwrap();
        assert_eq!((image.width, image.height), (60, 40));
        let error = image.rgb.iter().zip(picture(60, 40)).map(|(&a, b)| a.abs_diff(b)).max();
        assert!(error <= Some(if format == ImageFormat::Jpeg { 24 } else { 0 }), "{format:?} {error:?}");
        let info = probe(&bytes, &limits()).unwrap();
        assert_eq!((info.width, info.height), (60, 40));
    }
}

#[test]
fn grey_jpegs_become_rgb() {
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new(&mut bytes);
    encoder.write_image(&[120; 32 * 16], 32, 16, ExtendedColorType::L8).unwrap();
    let image = decode(&bytes, &limits()).unwrap();
    assert_eq!(image.rgb.len(), 32 * 16 * 3);
    assert!(image.rgb.iter().all(|value| value.abs_diff(120) < 3));
}

#[test]
fn every_truncation_is_an_error() {
    for format in
        [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP, ImageFormat::Bmp]
    {
        let bytes = encode(format, 200, 120);
        for percent in [1, 5, 20, 50, 90, 99] {
            let cut = &bytes[..bytes.len() * percent / 100];
            assert!(decode(cut, &limits()).is_err(), "{format:?} cut to {percent} %");
        }
    }
    let jpeg = encode(ImageFormat::Jpeg, 200, 120);
    let cut = decode(&jpeg[..jpeg.len() - 2], &limits());
    assert_eq!(cut.unwrap_err(), FeatureError::Truncated { format: "JPEG" });
}

#[test]
fn a_thumbnail_does_not_hide_a_truncation() {
    let jpeg = encode(ImageFormat::Jpeg, 200, 120);
    let bytes = with_app1(&jpeg, &encode(ImageFormat::Jpeg, 16, 16));
    assert!(decode(&bytes, &limits()).is_ok());
    assert!(decode(&bytes[..bytes.len() - 300], &limits()).is_err());
}

#[test]
fn what_is_no_image_is_said_so() {
    assert_eq!(decode(b"", &limits()).unwrap_err(), FeatureError::EmptyFile);
    assert_eq!(decode(b"just a text\n", &limits()).unwrap_err(), FeatureError::UnknownFormat);
    assert_eq!(probe(b"GIF89a...", &limits()).unwrap_err(), FeatureError::UnknownFormat);
    assert!(decode(&[0xFF, 0xD8, 0xFF, 0xE0], &limits()).is_err());
}

/// A chunk of a PNG.
fn chunk(kind: [u8; 4], data: &[u8]) -> Vec<u8> {
    let checked = [kind.as_slice(), data].concat();
    let mut crc = u32::MAX;
    for byte in &checked {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xEDB8_8320 * (crc & 1));
        }
    }
    [&(data.len() as u32).to_be_bytes(), checked.as_slice(), &(!crc).to_be_bytes()].concat()
}

/// So many zeros by deflate's fixed codes: a zero, then copies of 258 bytes from one before. The checksum is left out, which
/// no one gets to.
fn deflated_zeros(count: usize) -> Vec<u8> {
    let mut bits: Vec<bool> = vec![true, true, false];
    let mut add = |code: u32, length: u32| (0..length).rev().for_each(|at| bits.push(code >> at & 1 == 1));
    add(0b0011_0000, 8);
    for _ in 0..count / 258 {
        // The length 258, then the distance 1.
        add(0b1100_0101, 8);
        add(0, 5);
    }
    add(0, 7);
    let byte = |bits: &[bool]| bits.iter().enumerate().map(|(at, bit)| u8::from(*bit) << at).sum::<u8>();
    [&[0x78, 0x01], bits.chunks(8).map(byte).collect::<Vec<_>>().as_slice()].concat()
}

#[test]
fn what_a_png_has_beside_its_pixels_is_not_inflated_without_bound() {
    let png = encode(ImageFormat::Png, 60, 40);
    let after_header = 8 + 25;
    let with_profile = |zeros: usize| {
        let profile = [b"profile\0\0".as_slice(), &deflated_zeros(zeros)].concat();
        [&png[..after_header], &chunk(*b"iCCP", &profile), &png[after_header..]].concat()
    };
    // A profile of a gigabyte is passed over or an error, and never held.
    let bytes = with_profile(1 << 30);
    assert!(bytes.len() < 8 << 20);
    assert!(
        probe(&bytes, &limits()).is_ok_and(|info| info.width == 60) || decode(&bytes, &limits()).is_err()
    );
    let peak = peak_resident_bytes();
    assert!(peak < 900 << 20, "{peak} bytes");
}

/// Most memory that this process has held; 0 where the system does not say.
fn peak_resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM")).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|kilobytes| kilobytes.parse::<u64>().ok()).unwrap_or(0) << 10
}

#[test]
fn sizes_are_checked_before_pixels_are_allocated() {
    let mut bmp = encode(ImageFormat::Bmp, 8, 8);
    bmp[18..22].copy_from_slice(&100_000u32.to_le_bytes());
    bmp[22..26].copy_from_slice(&100_000u32.to_le_bytes());
    assert!(decode(&bmp, &limits()).is_err());
    let mut png = encode(ImageFormat::Png, 8, 8);
    png[16..24].copy_from_slice(&[0, 1, 0x86, 0xA0, 0, 1, 0x86, 0xA0]);
    // The header's checksum (PNG specification, annex D) is over the changed bytes.
    let mut checksum = u32::MAX;
    for byte in &png[12..29] {
        checksum ^= u32::from(*byte);
        for _ in 0..8 {
            checksum = if checksum & 1 == 1 { checksum >> 1 ^ 0xEDB8_8320 } else { checksum >> 1 };
        }
    }
    png[29..33].copy_from_slice(&(!checksum).to_be_bytes());
    for result in [decode(&png, &limits()).map(|_| ()), probe(&png, &limits()).map(|_| ())] {
        assert!(
            matches!(result, Err(FeatureError::TooLarge { width: 100_000, height: 100_000, .. })),
            "{result:?}"
        );
    }
    let small = DecodeLimits { max_side: 100, max_pixels: 1000 };
    for format in [ImageFormat::Jpeg, ImageFormat::WebP, ImageFormat::Tiff] {
        let error = decode(&encode(format, 50, 40), &small).unwrap_err();
        assert!(matches!(error, FeatureError::TooLarge { width: 50, height: 40, .. }), "{error}");
    }
}

#[test]
fn a_frame_without_pixels_is_refused() {
    let mut jpeg = encode(ImageFormat::Jpeg, 16, 16);
    let frame = jpeg.windows(2).position(|pair| pair == [0xFF, 0xC0]).unwrap();
    jpeg[frame + 5..frame + 9].fill(0);
    assert_eq!(decode(&jpeg, &limits()).unwrap_err(), FeatureError::NoPixels { width: 0, height: 0 });
}

#[test]
fn exif_orientation_turns_the_picture_upright() {
    // For each orientation, where the stored top-left pixel (dark) and top-right (red) belong.
    let corners: [(u8, [usize; 2], [usize; 2]); 8] = [
        (1, [0, 0], [1, 0]),
        (2, [1, 0], [0, 0]),
        (3, [1, 1], [0, 1]),
        (4, [0, 1], [1, 1]),
        (5, [0, 0], [0, 1]),
        (6, [1, 0], [1, 1]),
        (7, [1, 1], [1, 0]),
        (8, [0, 1], [0, 0]),
    ];
    let jpeg = encode(ImageFormat::Jpeg, 96, 64);
    for (orientation, top_left, top_right) in corners {
        let bytes = with_app1(&jpeg, &exif(&[(0x112, 3, &[orientation.into()])], &[], &[]));
        let image = decode(&bytes, &limits()).unwrap();
        let info = probe(&bytes, &limits()).unwrap();
        assert_eq!((image.width, image.height), if orientation > 4 { (64, 96) } else { (96, 64) });
        assert_eq!((info.width, info.height), (image.width, image.height));
        let at = |[x, y]: [usize; 2]| {
            let (x, y) = (x * (image.width as usize - 1), y * (image.height as usize - 1));
            &image.rgb[(y * image.width as usize + x) * 3..][..2]
        };
        assert!(at(top_left)[0] < 40 && at(top_left)[1] < 40, "{orientation}: {:?}", at(top_left));
        assert!(at(top_right)[0] > 200 && at(top_right)[1] < 40, "{orientation}: {:?}", at(top_right));
    }
}

/// How far the grey picture of a file is from that of its colours at most.
fn most_apart(bytes: &[u8]) -> u8 {
    let grey = decode_grey(bytes, &limits()).unwrap();
    let of_colors = GreyImage::from(&decode(bytes, &limits()).unwrap());
    assert_eq!((grey.width, grey.height), (of_colors.width, of_colors.height));
    grey.values.iter().zip(&of_colors.values).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn grey_pictures_are_those_of_the_colors() {
    for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP, ImageFormat::Bmp] {
        assert_eq!(most_apart(&encode(format, 96, 64)), 0, "{format:?}");
    }
    let jpeg = encode(ImageFormat::Jpeg, 96, 64);
    for orientation in 1..=8 {
        // Colours out of range are cut off, luma is not.
        let apart = most_apart(&with_app1(&jpeg, &exif(&[(0x112, 3, &[orientation])], &[], &[])));
        assert!(apart <= 4, "{orientation}: {apart}");
    }
    // The channels are said to be red, green and blue: none is luma.
    let adobe = [&jpeg[..2], b"\xFF\xEE\0\x0EAdobe\0\x64\0\0\0\0\0", &jpeg[2..]].concat();
    assert_eq!(most_apart(&adobe), 0);
    let mut grey = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new(&mut grey);
    encoder.write_image(&picture(96, 64)[..96 * 64], 96, 64, ExtendedColorType::L8).unwrap();
    assert_eq!(most_apart(&grey), 0);
    let cut = &jpeg[..jpeg.len() - 9];
    assert_eq!(decode_grey(cut, &limits()).unwrap_err(), decode(cut, &limits()).unwrap_err());
}

#[test]
fn exif_focal_length_and_position_are_read() {
    let jpeg = encode(ImageFormat::Jpeg, 96, 64);
    let gps: [(u16, u16, &[u32]); 6] = [
        (1, 2, &[u32::from(b'S')]),
        (2, 5, &[33, 1, 30, 1, 36, 1]),
        (3, 2, &[u32::from(b'E')]),
        (4, 5, &[151, 1, 12, 1, 0, 1]),
        (5, 1, &[1]),
        (6, 5, &[25, 2]),
    ];
    let sub: [(u16, u16, &[u32]); 2] = [(0x920A, 5, &[43, 10]), (0xA405, 3, &[26])];
    let metadata = ImageMetadata::read(&with_app1(&jpeg, &exif(&[(0x112, 3, &[1])], &sub, &gps)));
    assert_eq!((metadata.focal_35mm, metadata.focal_mm), (Some(26.0), Some(4.3)));
    let position = metadata.gps.unwrap();
    assert!((position.lat_deg + 33.51).abs() < 1e-9 && (position.lon_deg - 151.2).abs() < 1e-9);
    assert_eq!(position.alt_m, Some(-12.5));
    let (camera, source) = guess_camera(&ImageInfo { width: 4000, height: 3000, metadata });
    assert_eq!((camera.model, source), (CameraModel::Radial, CameraSource::ExifFocal35mm));
    assert!((camera.params[0] - 26.0 / 43.2666 * 5000.0).abs() < 0.01);
    let zero = ImageMetadata::read(&with_app1(&jpeg, &exif(&[], &[(0xA405, 3, &[0])], &[])));
    assert_eq!(zero.focal_35mm, None);
}

fn with_xmp(text: &str) -> ImageMetadata {
    let packet = [b"http://ns.adobe.com/xap/1.0/\0".as_slice(), text.as_bytes()].concat();
    ImageMetadata::read(&with_app1(&encode(ImageFormat::Jpeg, 16, 16), &packet))
}

fn gpano(text: &str) -> Option<GPano> {
    with_xmp(text).gpano
}

#[test]
fn what_gpano_says_to_be_of_another_projection_is_no_panorama_by_its_shape() {
    let metadata = with_xmp("GPano:ProjectionType=\"cylin\ndrical\" GPano:FullPanoWidthPixels=\"1536\"");
    assert_eq!((metadata.gpano, metadata.other_projection.as_deref()), (None, Some("cylindrical")));
    let (camera, source) = guess_camera(&ImageInfo { width: 1536, height: 768, metadata });
    assert_eq!((camera.is_panoramic(), source), (false, CameraSource::Fallback));
    assert_eq!(with_xmp("GPano:ProjectionType='Equirectangular'").other_projection, None);
    let endless = format!("GPano:ProjectionType=\"{}\"", "x".repeat(1000));
    assert_eq!(with_xmp(&endless).other_projection.map(|kind| kind.len()), Some(40));
}

#[test]
fn gpano_is_read_from_attributes_and_elements() {
    let attributes = gpano(
        r#"<rdf:Description GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="8000"
        GPano:FullPanoHeightPixels='4000' GPano:CroppedAreaImageWidthPixels = "6000"
        GPano:CroppedAreaImageHeightPixels="3000" GPano:CroppedAreaLeftPixels="1000" GPano:CroppedAreaTopPixels="400"
        GPano:PoseHeadingDegrees="271.5"/>"#,
    );
    let elements = gpano(
        "<GPano:ProjectionType>equirectangular</GPano:ProjectionType><GPano:FullPanoWidthPixels> 8000 </GPano:FullPanoWidthPixels>\
         <GPano:FullPanoHeightPixels>4000</GPano:FullPanoHeightPixels><GPano:CroppedAreaImageWidthPixels>6000</GPano:CroppedAreaImageWidthPixels>\
         <GPano:CroppedAreaImageHeightPixels>3000</GPano:CroppedAreaImageHeightPixels><GPano:CroppedAreaLeftPixels>1000</GPano:CroppedAreaLeftPixels>\
         <GPano:CroppedAreaTopPixels>400</GPano:CroppedAreaTopPixels><GPano:PoseHeadingDegrees>271.5</GPano:PoseHeadingDegrees>",
    );
    assert_eq!(attributes, elements);
    assert_eq!(attributes.unwrap().heading_deg, Some(271.5));
    let metadata = ImageMetadata { gpano: attributes, ..ImageMetadata::default() };
    // Scaled to half after it was written.
    let (camera, source) = guess_camera(&ImageInfo { width: 3000, height: 1500, metadata });
    assert_eq!(source, CameraSource::GPano);
    assert_eq!(camera.params, [4000.0, 2000.0, 500.0, 200.0]);
    // Scaled by a factor that has no exact binary fraction: still all round.
    let whole = GPano { full_width: Some(11000.0), full_height: Some(5500.0), ..GPano::default() };
    let metadata = ImageMetadata { gpano: Some(whole), ..ImageMetadata::default() };
    let (camera, _) = guess_camera(&ImageInfo { width: 4096, height: 2048, metadata });
    assert_eq!(camera, Camera::equirectangular(4096, 2048));
    assert!(camera.wraps_around());
    assert_eq!(gpano(r#"GPano:ProjectionType="cylindrical""#), None);
    assert_eq!(gpano("no such thing"), None);
}

#[test]
fn an_undescribed_image_gets_a_stated_guess() {
    let guess = |width, height, metadata| guess_camera(&ImageInfo { width, height, metadata });
    let nothing = ImageMetadata::default;
    assert_eq!(
        guess(4096, 2048, nothing()),
        (Camera::equirectangular(4096, 2048), CameraSource::AspectRatio)
    );
    let (photo, source) = guess(3000, 4000, nothing());
    assert_eq!((photo.params[0], source), (4800.0, CameraSource::Fallback));
    let phone = ImageMetadata { focal_35mm: Some(26.0), ..nothing() };
    assert_eq!(guess(4000, 2000, phone).1, CameraSource::ExifFocal35mm);
    let sensor = ImageMetadata {
        focal_mm: Some(50.0),
        pixels_per_mm: Some(160.0),
        original_longer: Some(6000.0),
        ..nothing()
    };
    let (camera, source) = guess(3000, 2000, sensor);
    assert_eq!((camera.params[0], source), (4000.0, CameraSource::ExifFocalPlane));
    let band = ImageMetadata { gpano: Some(GPano::default()), ..nothing() };
    assert_eq!(guess(4000, 1000, band).0.params, [4000.0, 2000.0, 0.0, 500.0]);
}
