"""Image files: decoded completely or not at all, with the size known before decoding."""

import hashlib
import os
import platform
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cvo_edge.errors import GateError, UsageError
from cvo_edge.input import half
from cvo_edge.input.decoding import MAX_PIXELS, decode_image, image_size
from cvo_edge.input.half import check_decoder
from cvo_edge.input.sources import open_source

SUFFIXES = (".jpg", ".png", ".bmp", ".ppm", ".pgm", ".tif", ".webp")


def picture(height=48, width=64, seed=0):
    """Return a smooth image with some noise, uint8 BGR."""
    noise = np.random.default_rng(seed).integers(0, 40, (height, width, 3))
    ramp = np.linspace(0, 200, width)[None, :, None]
    return (noise + ramp).astype(np.uint8)


def encoded(suffix, image):
    done, content = cv2.imencode(suffix, image if suffix != ".pgm" else image[:, :, 0])
    assert done
    return content.tobytes()


def bomb(side=32000):
    """Return a 1-bit PNG of 130 kB that would decode to gigabytes."""

    def chunk(name, data):
        checked = name + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes((side // 8 + 1) * side), 9)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )


def with_orientation(jpeg, orientation):
    """Add an EXIF segment that requests a rotation to the JPEG."""
    data = b"Exif\0\0" + exif(orientation)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(data) + 2) + data + jpeg[2:]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("size", [(16, 16), (17, 300), (1025, 33)])
def test_the_size_in_the_header_is_that_of_the_picture(suffix, size):
    assert image_size(encoded(suffix, picture(*size))) == size


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_cut_is_unreadable(suffix):
    content = encoded(suffix, picture())
    assert decode_image(content).shape == (48, 64, 3)
    for length in [*range(0, len(content), max(1, len(content) // 60)), len(content) - 1]:
        assert decode_image(content[:length]) is None, length


def test_a_thumbnail_does_not_end_a_cut_jpeg():
    content = encoded(".jpg", picture())
    thumbnail = encoded(".jpg", picture(16, 16))
    segment = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    whole = content[:2] + segment + content[2:]
    np.testing.assert_array_equal(decode_image(whole), decode_image(content))
    assert decode_image(whole[:-2]) is None
    # Cameras pad their buffers with zeros.
    np.testing.assert_array_equal(decode_image(whole + bytes(5000)), decode_image(content))


def test_a_bomb_is_refused_from_its_header_in_little_memory(tmp_path):
    content = bomb()
    assert len(content) < 200_000
    assert image_size(content) == (32000, 32000)
    path = tmp_path / "bomb.png"
    path.write_bytes(content)
    code = (
        "import resource, sys; from cvo_edge.input.decoding import decode_image; "
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; "
        "assert decode_image(open(sys.argv[1], 'rb').read()) is None; "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 20_000  # KiB


@pytest.mark.parametrize(("suffix", "place", "form"), [(".png", 16, ">II"), (".bmp", 18, "<ii")])
def test_a_header_that_asks_for_too_much_is_refused(suffix, place, form):
    content = encoded(suffix, picture(16, 16))

    def asking(height, width):
        numbers = struct.pack(form, width, height)
        return content[:place] + numbers + content[place + len(numbers) :]

    assert decode_image(asking(16, 16)) is not None
    assert image_size(asking(70000, 65000)) == (70000, 65000)
    assert MAX_PIXELS < 70000 * 65000
    assert decode_image(asking(70000, 65000)) is None


@pytest.mark.parametrize("suffix", [".png", ".tif", ".ppm"])
def test_16_bits_keep_their_upper_eight(suffix):
    wide = np.random.default_rng(1).integers(0, 65536, (48, 64, 3)).astype(np.uint16)
    np.testing.assert_array_equal(decode_image(encoded(suffix, wide)), (wide >> 8).astype(np.uint8))


@pytest.mark.parametrize("bits", [9, 10, 12, 16])
def test_a_camera_of_fewer_bits_keeps_the_upper_eight_of_them(bits, tmp_path):
    image = picture()
    wide = image.astype(np.uint16) << (bits - 8)
    path = tmp_path / "1.png"
    path.write_bytes(encoded(".png", wide))
    for source in (tmp_path, path, tmp_path / "*.png"):
        (frame,) = open_source(source, bit_depth=bits)
        np.testing.assert_array_equal(frame.image, image)
    assert decode_image(encoded(".png", wide + 256), 9).max() == 255
    with pytest.raises(UsageError, match="bit depth: expected 9 to 16 bits, found 8"):
        open_source(path, bit_depth=8)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_alpha_is_dropped_and_grey_repeated(suffix):
    image = picture()
    alpha = np.dstack([image, image[:, :, :1]])
    np.testing.assert_array_equal(decode_image(encoded(suffix, alpha)), image)
    grey = image[:, :, 0]
    done, content = cv2.imencode(suffix, grey)
    assert done
    np.testing.assert_array_equal(decode_image(content.tobytes()), np.dstack([grey] * 3))


def exif(orientation):
    return b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def turned_png(png, orientation):
    """Add an eXIf chunk behind the header of a PNG."""
    checked = b"eXIf" + exif(orientation)
    length, checksum = struct.pack(">I", len(checked) - 4), struct.pack(">I", zlib.crc32(checked))
    return png[:33] + length + checked + checksum + png[33:]


def turned_webp(webp, orientation):
    """Add an EXIF chunk behind the picture of a WebP of 64x48, which becomes an extended one."""
    canvas = bytes([0x08, 0, 0, 0]) + (63).to_bytes(3, "little") + (47).to_bytes(3, "little")
    data = exif(orientation)
    chunks = b"VP8X" + struct.pack("<I", 10) + canvas + webp[12:]
    chunks += b"EXIF" + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)
    return b"RIFF" + struct.pack("<I", 4 + len(chunks)) + b"WEBP" + chunks


def turned_tiff(tiff, orientation, kind=3):
    """Add tag 274 to a TIFF, in a copy of its tags at the end."""
    (begin,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, begin)
    tags = [tiff[begin + 2 + 12 * n : begin + 14 + 12 * n] for n in range(count)]
    tags = [tag for tag in tags if tag[:2] != struct.pack("<H", 274)]
    tags.append(struct.pack("<HHII", 274, kind, 1, orientation))
    listed = struct.pack("<H", len(tags)) + b"".join(sorted(tags, key=lambda tag: tag[1::-1]))
    return tiff[:4] + struct.pack("<I", len(tiff)) + tiff[8:] + listed + bytes(4)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("suffix", "turned"),
    [
        (".jpg", with_orientation),
        (".png", turned_png),
        (".webp", turned_webp),
        (".tif", turned_tiff),
    ],
)
def test_the_camera_s_own_pixel_order_is_kept(suffix, turned, orientation):
    content = encoded(suffix, picture())
    found = decode_image(turned(content, orientation))
    np.testing.assert_array_equal(found, decode_image(content))


@pytest.mark.parametrize("order", "<>")
def test_a_tiff_of_either_byte_order_and_any_type_of_the_tag_is_not_turned(order):
    pixels = bytes(range(256))
    tags = [(256, 3, 16), (257, 3, 16), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8)]
    tags += [(274, 4, 6), (277, 3, 1), (278, 3, 16), (279, 4, 256)]
    entries = b"".join(
        struct.pack(order + ("HHII" if kind == 4 else "HHIHxx"), tag, kind, 1, value)
        for tag, kind, value in tags
    )
    start = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8 + len(pixels))
    content = start + pixels + struct.pack(order + "H", len(tags)) + entries + bytes(4)
    expected = np.frombuffer(pixels, np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(decode_image(content)[:, :, 0], expected)


NO_HEADER = (
    b"",
    b"\xff\xd8",
    b"\xff\xd8 no jpeg \xff\xd9",
    b"\x89PNG\r\n\x1a\n",
    b"BM",
    b"P6",
    b"P6 0 0 255\n",
    b"II*\0",
    b"MM\0*" + b"\xff" * 60,
    b"RIFF1234WEBPVP8X",
    b"GIF89a" + bytes(20),
)


@pytest.mark.parametrize("content", NO_HEADER, ids=str)
def test_what_has_no_header_is_no_image(content):
    assert decode_image(content) is None


def test_numbers_that_are_no_pixels_are_no_image():
    done, content = cv2.imencode(".tif", picture().astype(np.float32))
    assert done
    assert decode_image(content.tobytes()) is None


@settings(max_examples=200)
@given(data=st.data(), suffix=st.sampled_from(SUFFIXES))
def test_whatever_the_bytes_it_is_none_or_the_picture_of_the_header(data, suffix):
    content = bytearray(encoded(suffix, picture(20, 24)))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    image = decode_image(bytes(content))
    if image is not None:
        assert image.dtype == np.uint8
        assert image.shape == (*image_size(bytes(content)), 3)
    small = decode_image(bytes(content), decode="half")
    if small is not None:
        assert small.shape == (*((side + 1) // 2 for side in image_size(bytes(content))), 3)


@settings(max_examples=300)
@given(
    st.sampled_from([b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"BM", b"P6", b"II*\0", b"RIFF"]),
    st.binary(),
)
def test_no_header_is_an_error(start, rest):
    image_size(start + rest)


JPEG_FORMS = [
    (factor, progressive) for factor in (411, 420, 422, 440, 444) for progressive in (0, 1)
]


def jpeg_of(image, factor, progressive, quality=90):
    options = {
        cv2.IMWRITE_JPEG_QUALITY: quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR: getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{factor}"),
        cv2.IMWRITE_JPEG_PROGRESSIVE: progressive,
    }
    done, content = cv2.imencode(".jpg", image, [x for pair in options.items() for x in pair])
    assert done
    return content.tobytes()


@pytest.mark.parametrize("form", JPEG_FORMS)
@pytest.mark.parametrize("shape", [(48, 64), (51, 67)])
def test_half_a_jpeg_is_close_to_the_means_of_four_pixels(form, shape):
    """Of a smooth picture: a grey level; the size is rounded upwards."""
    smooth = cv2.GaussianBlur(picture(*shape), (0, 0), 3)
    content = jpeg_of(smooth, *form)
    found = decode_image(content, decode="half")
    assert found.shape == ((shape[0] + 1) // 2, (shape[1] + 1) // 2, 3)
    rows, columns = shape[0] // 2, shape[1] // 2
    whole = decode_image(content)[: 2 * rows, : 2 * columns].astype(float)
    means = whole.reshape(rows, 2, columns, 2, 3).mean(axis=(1, 3))
    assert np.abs(found[:rows, :columns] - means).mean() < 1.0


def test_half_a_picture_ignores_the_orientation_and_refuses_what_is_cut_or_no_jpeg():
    content = encoded(".jpg", picture())
    upright = decode_image(content, decode="half")
    turned = decode_image(with_orientation(content, 6), decode="half")
    np.testing.assert_array_equal(upright, turned)
    assert decode_image(content[:-2], decode="half") is None
    for suffix in set(SUFFIXES) - {".jpg", ".jpeg"}:
        assert decode_image(encoded(suffix, picture()), decode="half") is None


def test_another_rule_of_halving_is_found_out(monkeypatch):
    """E.g. the means of four pixels, or the chroma of another library."""
    check_decoder()
    whole = decode_image(half._KNOWN)
    for other in (None, cv2.resize(whole, (21, 14), interpolation=cv2.INTER_AREA)):
        monkeypatch.setattr(half, "decode_image", lambda *_, other=other, **__: other)
        with pytest.raises(GateError, match="libjpeg-turbo"):
            check_decoder()


OTHER = Path(__file__).resolve().parents[2] / ".opencv4"
# An emulated board finds the host's copy there.
TAGS = "".join(path.read_text("utf-8") for path in OTHER.glob("*.dist-info/WHEEL")).lower()


@pytest.mark.skipif(
    platform.machine().lower() not in TAGS or cv2.__version__.startswith("4."),
    reason="needs OpenCV 5, and OpenCV 4.10 for this machine in .opencv4: make test",
)
def test_another_release_of_opencv_reads_the_same(tmp_path, clip_dir):
    """OpenCV 4.10 and this release decode intact, cut and altered files of every format alike."""
    generator = np.random.default_rng(2)
    contents = [path.read_bytes() for path in sorted(clip_dir.glob("*.jpg"))[:5]]
    wide = generator.integers(0, 65536, (48, 64, 3)).astype(np.uint16)
    for suffix in SUFFIXES:
        whole = encoded(suffix, picture())
        contents += [whole, whole[: len(whole) // 2], whole[:-1]]
        for _ in range(20):
            changed = bytearray(whole)
            changed[generator.integers(len(changed))] ^= 1 << int(generator.integers(8))
            contents.append(bytes(changed))
    contents += [jpeg_of(picture(51, 67), *form) for form in JPEG_FORMS]
    contents += [encoded(suffix, wide) for suffix in (".png", ".tif", ".ppm")]
    contents += [with_orientation(contents[0], 6), contents[0] + bytes(100)]
    contents += [turned_tiff(encoded(".tif", picture()), number) for number in (3, 6)]
    contents.append(encoded(".tif", picture().astype(np.float32)))
    contents.append(encoded(".png", np.dstack([picture(), picture()[:, :, :1]])))
    for number, content in enumerate(contents):
        (tmp_path / f"{number:04d}").write_bytes(content)
    code = (
        "import cv2, hashlib, sys; from pathlib import Path; "
        "from cvo_edge.input.decoding import decode_image; print(cv2.__version__); "
        "files = [p.read_bytes() for p in sorted(Path(sys.argv[1]).iterdir())]; "
        "images = [decode_image(f, decode=d) for d in ('full', 'half') for f in files]; "
        "print(*(i if i is None else hashlib.sha256(i).hexdigest() for i in images), sep='\\n')"
    )
    path = os.pathsep.join([str(OTHER), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    version, *theirs = done.stdout.split()
    assert version.split(".")[0] != cv2.__version__.split(".")[0]
    ours = [decode_image(each, decode=decode) for decode in ("full", "half") for each in contents]
    expected = ["None" if i is None else hashlib.sha256(i).hexdigest() for i in ours]
    assert [(n, a) for n, a in enumerate(theirs)] == [(n, b) for n, b in enumerate(expected)]


def framed(jpeg, height, width):
    """Change the size in the JPEG's frame header."""
    place = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:place] + struct.pack(">HH", height, width) + jpeg[place + 4 :]


def tagged(*tags, picture=bytes(256)):
    """Return a TIFF of 16x16 grey pixels that starts with these tags: (tag, type, count, value)."""
    rest = [
        *((258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, 8), (277, 3, 1, 1)),
        *((278, 4, 1, 16), (279, 4, 1, len(picture))),
    ]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in (*tags, *rest))
    count = struct.pack("<H", len(tags) + len(rest))
    return b"II*\0" + struct.pack("<I", 8 + len(picture)) + picture + count + entries + bytes(4)


def hidden_jpeg():
    """Return a JPEG that starts with a marker without a length.

    A parser that reads a length there skips the true header.
    """
    jpeg = encoded(".jpg", picture(16, 16))
    large = b"\xff\xd8\xff\x01" + framed(jpeg, 20000, 40000)[2:-2]
    # Read as a length, these bytes (0xffe0) lead to a small picture further on.
    return large + bytes(4 + 0xFFE0 - len(large)) + jpeg[2:]


def extended_webp(height, width):
    """Return an extended WebP whose canvas differs from the size of its picture."""
    webp = encoded(".webp", picture(16, 16))
    sizes = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + sizes + webp[12:]
    return b"RIFF" + struct.pack("<I", len(body)) + body


SIZE_TAGS = ((256, 4, 1, 16), (257, 4, 1, 16))
TWO_SIZES = {
    "a JPEG with a bare marker": hidden_jpeg(),
    "a JPEG with two frame headers": (
        lambda jpeg: framed(jpeg, 20000, 30000)[: jpeg.index(b"\xff\xda")] + jpeg[2:]
    )(encoded(".jpg", picture(16, 16))),
    "a TIFF with its width twice": tagged((256, 4, 1, 30000), (257, 4, 1, 20000), *SIZE_TAGS),
    "a TIFF of large tiles": tagged(*SIZE_TAGS, (322, 3, 1, 9008), (323, 3, 1, 9008)),
    "a BMP of OS/2": b"BM"
    + struct.pack("<IHHI", 0, 0, 0, 32)
    + struct.pack("<IHHHH", 12, 65535, 16000, 1, 1)
    + bytes(4096),
    "a PNM with a carriage return": b"P5 #\r40000 20000 #\n 16 16\n255\n" + bytes(256),
    "a WebP with another canvas": extended_webp(20000, 16000),
}


@pytest.mark.parametrize("name", TWO_SIZES)
def test_what_says_two_sizes_is_not_decoded(name, monkeypatch):
    asked = []
    monkeypatch.setattr(cv2, "imdecode", lambda *_: asked.append(name))
    assert decode_image(TWO_SIZES[name]) is None
    assert asked == []


def test_the_same_headers_with_one_size_are_read():
    content = tagged(*SIZE_TAGS, picture=bytes(range(256)))
    assert decode_image(content)[:, :, 1].ravel().tolist() == list(range(256))
    assert decode_image(b"P5 # a\n16 # b\n 16\n255\n" + bytes(256)).shape == (16, 16, 3)
    assert image_size(extended_webp(16, 16)) == (16, 16)


def test_a_picture_of_many_passes_is_refused_and_one_of_ten_is_not():
    jpeg = cv2.imencode(".jpg", picture(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scans = jpeg.count(b"\xff\xda")
    assert scans > 1
    assert decode_image(jpeg) is not None
    scan = jpeg[jpeg.rindex(b"\xff\xda") : -2]
    assert decode_image(jpeg[:-2] + 100 * scan + jpeg[-2:]) is None


def test_only_scans_before_the_end_of_a_progressive_jpeg_count():
    """Cameras append a video or a picture, whose bytes look like scans."""
    done, content = cv2.imencode(".jpg", picture(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert done
    jpeg = content.tobytes()
    whole = decode_image(jpeg)
    for rest in (b"\xff\xda" * 100, jpeg, bytes(64)):
        np.testing.assert_array_equal(decode_image(jpeg + rest), whole)
    scan = jpeg.rindex(b"\xff\xda")
    # An end marker within a segment ends nothing.
    hidden = b"\xff\xe5\x00\x04\xff\xd9" + 100 * jpeg[scan:-2]
    assert image_size(jpeg[:scan] + hidden + jpeg[-2:]) is None


@pytest.mark.parametrize("frame", [b"\xff\xc0", b"\xff\xc1"])
def test_scans_are_counted_where_a_decoder_reads_more_than_one(frame):
    """A first scan of all components is the only one read; one of fewer components is not."""
    jpeg = cv2.imencode(".jpg", picture())[1].tobytes().replace(b"\xff\xc0", frame, 1)
    start = jpeg.index(b"\xff\xda")
    assert jpeg[start + 4] == 3
    many = jpeg[:-2] + 100 * jpeg[start:]
    assert image_size(many) == image_size(jpeg) is not None
    decoded = decode_image(many)
    assert decoded is None or np.array_equal(decoded, decode_image(jpeg))
    for scans in (1, 100):
        planar = jpeg[:start] + scans * (b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00") + jpeg[-2:]
        assert (image_size(planar) is None) == (scans > 64)


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xd8" + bytes([0xFF]) * 10**7,
        b"\xff\xd8" + b"\xff\xe0\x00\x02" * 10**6,
        b"RIFF\0\0\0\0WEBP" + b"abcd\0\0\0\0" * 10**6,
    ],
)
def test_a_header_without_an_end_in_sight_is_none(content):
    for _ in range(100):
        assert image_size(content) is None
