"""Noise: its effect on pixels and on coverage."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_export.calibrate import calibrate
from cvo_export.cli import app
from cvo_export.data.noise import KINDS, Noise, noisy, parse_noise
from cvo_export.data.splits import make_split, same_split
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level, table

from .conftest import DATASET


def picture(height=48, width=64):
    generator = np.random.default_rng(7)
    return generator.integers(0, 256, (height, width, 3)).astype(np.uint8)


def grey(level, height=200, width=300):
    return np.full((height, width, 3), level, np.uint8)


def degraded(text, image, seed=0):
    return parse_noise(text).degrade(image, np.random.default_rng(seed))


# -- every kind -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KINDS)
def test_strength_zero_changes_no_byte(name):
    np.testing.assert_array_equal(degraded(f"{name}:0", picture()), picture())


@pytest.mark.parametrize("name", KINDS)
def test_the_default_is_seen_and_shape_type_and_input_stay(name):
    image = picture()
    found = degraded(name, image)
    assert found.shape == image.shape
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(image, picture())
    assert not np.shares_memory(found, image)
    assert np.abs(found.astype(int) - image).mean() > 2.0


@pytest.mark.parametrize("name", KINDS)
def test_the_ends_of_every_range_are_served(name):
    kind = KINDS[name]
    assert kind.lowest <= kind.default <= kind.highest
    for strength in (kind.lowest, kind.highest):
        found = Noise(name, strength).degrade(picture(), np.random.default_rng(0))
        assert found.shape == picture().shape


@pytest.mark.parametrize("name", KINDS)
def test_a_frame_depends_on_seed_and_number_but_on_no_order(name):
    dataset = open_dataset("synthetic:room,flights=1,frames=4,size=64x48")
    worse, again = (noisy(dataset, parse_noise(name), 3) for _ in range(2))
    forward = [worse.read_image(index) for index in range(4)]
    backward = [again.read_image(index) for index in reversed(range(4))][::-1]
    np.testing.assert_array_equal(forward, backward)
    if name != "exposure":  # not random
        other = noisy(dataset, parse_noise(name), 4).read_image(0)
        assert not np.array_equal(other, forward[0])
        of_one_image = [
            parse_noise(name).degrade(picture(), np.random.default_rng((3, index)))
            for index in range(2)
        ]
        assert not np.array_equal(*of_one_image)


def test_a_noisy_data_set_has_the_frames_and_splits_of_the_clean_one():
    dataset = open_dataset(DATASET)
    worse = noisy(dataset, parse_noise("speckle"), 0)
    assert (worse.name, worse.frame_names) == (dataset.name, dataset.frame_names)
    recorded = make_split(dataset, "random", 5).spec(dataset)
    np.testing.assert_array_equal(
        same_split(worse, recorded).roles["test"], same_split(dataset, recorded).roles["test"]
    )
    assert not np.array_equal(worse.read_image(0), dataset.read_image(0))


# -- each kind ------------------------------------------------------------------------------------


@pytest.mark.parametrize("strength", [0.02, 0.1])
def test_gaussian_has_its_deviation_about_the_level(strength):
    image = grey(128)
    image[0, 0, 0] = 127  # makes the image a colour image
    difference = degraded(f"gaussian:{strength}", image).astype(float) - 128
    assert difference.std() == pytest.approx(255 * strength, rel=0.01)
    assert abs(difference.mean()) < 0.2
    channels = np.corrcoef(difference.reshape(-1, 3).T)
    assert np.abs(channels - np.eye(3)).max() < 0.02


@pytest.mark.parametrize("name", ["gaussian", "speckle"])
def test_a_grey_camera_has_one_channel_of_noise(name):
    found = degraded(name, grey(128))
    assert found.std() > 1.0
    assert (found == found[..., :1]).all()


@pytest.mark.parametrize("strength", [0.05, 0.3, 1.0])
def test_salt_and_pepper_turns_its_share_of_pixels_white_or_black(strength):
    found = degraded(f"salt-and-pepper:{strength}", grey(128))
    white, black = (found == 255).all(axis=2).mean(), (found == 0).all(axis=2).mean()
    assert white == pytest.approx(strength / 2, abs=0.005)
    assert black == pytest.approx(strength / 2, abs=0.005)
    # Only whole pixels change; all others stay the same.
    assert white + black + (found == 128).all(axis=2).mean() == pytest.approx(1.0)


def test_speckle_is_proportional_to_the_level():
    for level in (20, 60, 120):
        difference = degraded("speckle:0.2", grey(level)).astype(float) - level
        # Rounding to whole grey levels adds a variance of 1/12.
        assert difference.std() == pytest.approx(np.hypot(0.2 * level, 12**-0.5), rel=0.02)
        assert abs(difference.mean()) < 0.2
    assert not degraded("speckle:1", grey(0)).any()


@pytest.mark.parametrize("seed", range(5))
def test_motion_blur_smears_a_point_along_a_line_of_its_length(seed):
    """The standard deviation along a uniform line of length L is L / sqrt(12)."""
    image = grey(0, 240, 320)
    image[117:124, 157:164] = 255
    light = degraded("motion-blur:0.1", image, seed)[..., 0].astype(float)
    assert light.sum() == pytest.approx(49 * 255, rel=0.03)
    y, x = np.mgrid[:240, :320]
    offsets = np.stack([x - 160, y - 120]).reshape(2, -1)
    weights = light.reshape(-1) / light.sum()
    np.testing.assert_allclose(offsets @ weights, 0, atol=0.1)
    across, along = np.linalg.eigvalsh((offsets * weights) @ offsets.T)
    block = 4.0  # (7^2 - 1) / 12, the variance of the square
    assert np.sqrt(12 * (along - block)) == pytest.approx(32, abs=1.0)
    assert across == pytest.approx(block, abs=0.5)


def test_motion_blur_keeps_brightness_and_takes_every_direction():
    image = cv2.GaussianBlur(picture(120, 160), (0, 0), 3)
    angles = []
    for seed in range(40):
        blurred = degraded("motion-blur:0.05", image, seed)
        assert blurred.mean() == pytest.approx(image.mean(), rel=0.01)
        point = grey(0, 61, 81)
        point[30, 40] = 255
        y, x = np.nonzero(degraded("motion-blur:0.2", point, seed)[..., 0])
        covariance = np.cov(np.stack([x, y]))
        angles.append(np.arctan2(*np.linalg.eigh(covariance)[1][::-1, 1]) % np.pi)
    assert len({int(angle // (np.pi / 4)) for angle in angles}) == 4


def linear(coded):
    """Decode sRGB values to linear light (0 to 1) with the standard's two-piece curve."""
    coded = np.asarray(coded) / 255
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("stops", [-3, -1, 0.5, 1, 2])
def test_a_stop_doubles_linear_light_until_it_is_white(stops):
    levels = np.arange(256, dtype=np.uint8)
    image = np.broadcast_to(levels[:, None, None], (256, 4, 3)).copy()
    found = degraded(f"exposure:{stops}", image)
    assert (found == found[:, :1, :1]).all()
    half_a_level = (
        linear(np.minimum(found[:, 0, 0] + 0.5, 255)),
        linear(np.maximum(found[:, 0, 0] - 0.5, 0)),
    )
    expected = np.minimum(linear(levels) * 2.0**stops, 1)
    assert (half_a_level[1] - 1e-9 <= expected).all()
    assert (expected <= half_a_level[0] + 1e-9).all()
    assert (np.diff(found[:, 0, 0].astype(int)) >= 0).all()


@pytest.mark.parametrize("share", [0.01, 0.1, 0.5, 1.0])
def test_occlusion_covers_its_share_of_the_area_by_one_rectangle(share):
    image = np.indices((240, 320)).sum(axis=0)[..., None].repeat(3, axis=2).astype(np.uint8)
    places = set()
    for seed in range(10):
        found = degraded(f"occlusion:{share}", image, seed)
        y, x = np.nonzero((found != image).any(axis=2))
        rectangle = found[y.min() : y.max() + 1, x.min() : x.max() + 1]
        assert rectangle.shape[0] * rectangle.shape[1] == pytest.approx(share * 240 * 320, rel=0.05)
        assert len(np.unique(rectangle.reshape(-1, 3), axis=0)) == 1
        places.add((y.min(), x.min()))
    assert len(places) == (1 if share == 1.0 else 10)


# -- texts ----------------------------------------------------------------------------------------

NAMES = "gaussian, salt-and-pepper, speckle, motion-blur, exposure, occlusion"


@pytest.mark.parametrize("name", KINDS)
def test_a_name_alone_is_its_default_and_a_noise_reads_as_it_is_written(name):
    assert parse_noise(name) == Noise(name, KINDS[name].default)
    assert parse_noise(f"{name}:0.125") == Noise(name, 0.125)
    noise = Noise(name, 1 / 3)
    assert parse_noise(str(noise)) == noise


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", f"noise: expected NAME or NAME:STRENGTH with NAME one of {NAMES}, found ''"),
        ("fog", f"noise: expected NAME or NAME:STRENGTH with NAME one of {NAMES}, found 'fog'"),
        ("fog:1", f"noise: expected NAME or NAME:STRENGTH with NAME one of {NAMES}, found 'fog:1'"),
        (
            "speckle:",
            "noise speckle: expected a strength of 0 to 1 (deviation, share of the pixel's own "
            "level), found ''",
        ),
        (
            "gaussian:25",
            "noise gaussian: expected a strength of 0 to 1 (deviation, share of the full range), "
            "found 25",
        ),
        (
            "salt-and-pepper:nan",
            "noise salt-and-pepper: expected a strength of 0 to 1 (share of the pixels), found nan",
        ),
        (
            "motion-blur:long",
            "noise motion-blur: expected a strength of 0 to 0.5 (length, share of the image's "
            "width), found 'long'",
        ),
        (
            "exposure:-inf",
            "noise exposure: expected a strength of -8 to 8 (stops, negative is darker), found "
            "-inf",
        ),
        (
            "occlusion:-0.1",
            "noise occlusion: expected a strength of 0 to 1 (share of the image's area), found "
            "-0.1",
        ),
    ],
)
def test_another_text_is_refused_in_one_line(text, message):
    with pytest.raises(UsageError) as caught:
        parse_noise(text)
    assert str(caught.value) == message


# -- evaluation -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(tiny_bundle, tiny_run):
    return evaluate(tiny_bundle, tiny_run.dataset, "test", noise=parse_noise("speckle:0.6"))


@pytest.fixture(scope="module")
def clean_report(tiny_bundle, tiny_run):
    return evaluate(tiny_bundle, tiny_run.dataset, "test")


@pytest.mark.parametrize("scope", ["marginal", "joint"])
def test_noise_breaks_coverage_and_recalibration_mends_it_by_wider_sets(
    report, clean_report, scope
):
    clean = find_level(report["levels"], 0.9, scope)
    mended = find_level(report["recalibrated"]["levels"], 0.9, scope)
    low, high = mended["coverage_band"]
    assert mended["coverage_band_exact"]
    holds = "joint_coverage" if scope == "joint" else "coverage"
    assert (np.array(clean[holds]) < low).all()
    assert (low <= np.array(mended[holds])).all()
    assert (np.array(mended[holds]) <= high).all()
    assert (np.array(mended["mean_width"]) > 1.2 * np.array(clean["mean_width"])).all()
    assert clean_report["noise"] is None
    assert "recalibrated" not in clean_report


def test_clean_thresholds_claim_no_band_under_noise(report):
    assert not any(level["coverage_band_exact"] for level in report["levels"])
    for key in ("coverage_band", "coverage_band_effective"):
        assert [level[key] for level in report["levels"]] == [None] * 10
        assert any(level[key] for level in report["recalibrated"]["levels"])


def test_the_report_says_which_noise_and_its_table_has_both_policies(report):
    assert report["noise"] == {"name": "speckle", "strength": 0.6, "seed": 0}
    assert report["recalibrated"]["n_calibration"] + report["recalibrated"]["left_out"] == 64
    json.dumps(report, allow_nan=False)
    lines = table(report)
    assert "noise speckle:0.6 (deviation, share of the pixel's own level), seed 0" in lines
    clean = lines.index("clean: the bundle's own thresholds, from 64 frames without noise")
    again = lines.index(
        "recalibrated: thresholds from 64 calibration frames with the same noise; 0 left out"
    )
    for part, footnotes in ((lines[clean:again], 1), (lines[again:], 0)):
        assert sum(bool(re.match(r"0\.\d+ +marginal +\d", line)) for line in part) == 5
        assert sum(line.startswith("flight-") for line in part) == 8
        assert sum(line.startswith("- no band: ") for line in part) == footnotes


def test_without_any_strength_both_policies_are_the_clean_evaluation(
    clean_report, tiny_bundle, tiny_run
):
    """Recalibration on the same pixels gives bit-identical thresholds."""
    found = evaluate(tiny_bundle, tiny_run.dataset, "test", noise=Noise("gaussian", 0.0))
    assert found["recalibrated"]["levels"] == clean_report["levels"]
    assert found["sequences"] == clean_report["sequences"]
    assert found["point_error"] == clean_report["point_error"]
    for key in ("coverage", "joint_coverage", "mean_width", "interval_score"):
        assert [level[key] for level in found["levels"]] == [
            level[key] for level in clean_report["levels"]
        ]


def test_frames_that_a_check_flags_are_counted_in_both_roles(tiny_bundle, tiny_run):
    """An image that cannot be read is also invalid under noise."""
    broken = {int(tiny_run.split.roles[role][0]) for role in ("cal", "test")}
    dataset = open_dataset(DATASET)
    read_image = dataset.read_image

    def read(index):
        if index in broken:
            raise SourceError("damaged")
        return read_image(index)

    found = evaluate(
        tiny_bundle, replace(dataset, read_image=read), "test", noise=parse_noise("occlusion")
    )
    assert found["frames"]["invalid"] == 1
    assert found["recalibrated"]["left_out"] == 1
    assert found["recalibrated"]["n_calibration"] == 63


def test_a_split_by_sequence_is_indicative_after_recalibration(tiny_bundle, tmp_path):
    other = open_dataset("synthetic:room,flights=12,frames=10,size=64x48,seed=4")
    calibration = calibrate(
        *(tiny_bundle, other, tmp_path / "b", "b"), kind="sequence", rule="pooled", new_data=True
    )
    found = evaluate(tmp_path / "b", other, "test", noise=parse_noise("exposure"))
    level = find_level(found["recalibrated"]["levels"], 0.9, "marginal")
    assert level["coverage_band"] is not None
    assert not level["coverage_band_exact"]
    assert "other_rule" not in found
    assert found["recalibrated"]["n_calibration"] == calibration.calibration.n
    lines = table(found)
    assert sum(line.startswith("? indicative: frames of one recording") for line in lines) == 1
    low, high = level["coverage_band_effective"]
    assert low < level["coverage_band"][0]
    (row,) = [line for line in lines if re.match(r"0\.9 +marginal +\d", line)][1:]
    assert f"{low:.3f}-{high:.3f}?" in row


def test_the_command_line_takes_a_noise_and_refuses_it_on_unseen_data(
    tiny_bundle, clean_report, capsys
):
    arguments = ["evaluate", str(tiny_bundle), DATASET, "--noise", "salt-and-pepper:0.2"]
    app([*arguments, "--json", "-"], standalone_mode=False)
    found = json.loads(capsys.readouterr().out)
    assert found["noise"] == {"name": "salt-and-pepper", "strength": 0.2, "seed": 0}
    assert found["point_error"]["median_m"] > clean_report["point_error"]["median_m"]
    with pytest.raises(UsageError) as caught:
        app([*arguments, "--subset", "all"], standalone_mode=False)
    assert str(caught.value) == (
        "noise: expected --subset test, whose split has calibration frames to recalibrate "
        "on, found all"
    )
    with pytest.raises(UsageError, match="NAME one of gaussian"):
        app([*arguments[:-1], "fog"], standalone_mode=False)
