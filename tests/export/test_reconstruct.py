"""Laws of ``reconstruct``: frames, scale, similarity, resumption, refusals, one small map."""

from __future__ import annotations

import shutil
from functools import partial

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.camera import Camera
from cvo_edge.errors import SinkError, SourceError, UsageError
from cvo_edge.geometry import quaternion_to_matrix
from cvo_export.datasets import open_dataset
from cvo_export.datasets.colmap_cameras import camera_of
from cvo_export.reconstruct import choice, pairs, recordings, scale, similarity, stages, tags
from cvo_export.reconstruct.mapping import in_process
from cvo_export.reconstruct.model import (
    Model,
    colmap_camera,
    read_intrinsics,
    read_model,
)
from cvo_export.reconstruct.report import Gap, Report, gaps, report_lines
from cvo_export.reconstruct.run import Options, reconstruct

RNG = np.random.default_rng(7)
LENS = Camera(
    width=640,
    height=480,
    fx=500.0,
    fy=510.0,
    cx=320.0,
    cy=236.0,
    distortion="radial_tangential",
    coefficients=(-0.2, 0.05, 1e-3, -2e-3),
)


def ignore(*_):
    """Report no progress."""


def random_poses(n, spread=1.0):
    turns = Rotation.random(n, random_state=3).as_quat()
    turns[turns[:, 3] < 0] *= -1
    return np.column_stack([RNG.normal(0, spread, (n, 3)), turns])


# --------------------------------------------------------------------------------- frame choice


def test_each_step_of_motion_gives_its_sharpest_frame():
    motions = np.full(60, 0.01)
    sharp = RNG.uniform(size=60)
    found = choice.chosen(motions, sharp, 0.05)
    windows = np.floor(np.cumsum([0, *motions[1:]]) / 0.05).astype(int)
    assert found == [
        max(np.flatnonzero(windows == k), key=lambda row: sharp[row])
        for k in range(windows[-1] + 1)
    ]


def test_a_camera_that_stands_gives_one_frame():
    assert choice.chosen([0.0] * 50, RNG.uniform(size=50), 0.04).__len__() == 1


def test_a_cut_gives_a_frame_of_either_side():
    motions = [0.0, 0.0, choice.LOST, 0.0, 0.0]
    assert choice.chosen(motions, [1, 3, 2, 4, 9], 0.04) == [1, 4]


@pytest.mark.parametrize("most", [2, 7, 30, 500])
def test_the_step_grows_until_the_frames_fit(most):
    walks = [(RNG.exponential(0.02, 300), RNG.uniform(size=300)) for _ in range(2)]
    step = choice.fitting_step(walks, 0.04, most)
    count = sum(len(choice.chosen(*walk, step)) for walk in walks)
    assert count <= most
    assert step == 0.04 or count > 0.7 * most - 2


def test_motion_is_the_shift_in_image_widths():
    pattern = cv2.GaussianBlur(RNG.integers(0, 256, (260, 360), np.uint8), (0, 0), 2.0)
    pattern = cv2.normalize(pattern, None, 0, 255, cv2.NORM_MINMAX)
    before, after = pattern[10:250, 10:330], pattern[10:250, 16:336]
    assert choice.motion(before, after) == pytest.approx(6 / 320, rel=0.02)
    assert choice.motion(before, before) == 0.0
    assert choice.motion(before, np.zeros_like(before)) == choice.LOST
    assert choice.motion(np.zeros_like(before), before) == 0.0


def test_blur_lowers_the_sharpness():
    image = RNG.integers(0, 256, (60, 80, 3), np.uint8)
    assert choice.sharpness(cv2.blur(image, (3, 3))) < 0.5 * choice.sharpness(image)


# --------------------------------------------------------------------------------------- pairs


def test_sequences_are_matched_ahead_and_across_powers_of_two():
    names = [recordings.image_name("a", n) for n in range(40)] + ["b/frame-000000.jpg"]
    found = pairs.sequential_pairs(names)
    assert {j for i, j in found if i == 0} == {1, 2, 3, 4, 5, 6, 8, 16, 32}
    assert not any(40 in pair for pair in found)


def test_likeness_closes_a_loop():
    """Images of one place are most alike, however far apart in time."""
    places = RNG.integers(0, 256, (20, 60, 128))
    shown = [*range(20), *range(20)]
    noisy = [(places[k] + RNG.integers(-9, 10, (60, 128))).clip(0, 255) for k in shown]
    found = pairs.alike_pairs(pairs.vlad([each.astype(np.uint8) for each in noisy]), most=1)
    assert found == {(k, k + 20) for k in range(20)}


# ------------------------------------------------------------------- cameras and similarities


@pytest.mark.parametrize(
    "camera",
    [
        Camera(width=64, height=48, fx=60.0, fy=61.0, cx=31.0, cy=23.0),
        LENS,
        msgspec.structs.replace(LENS, coefficients=(-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)),
        msgspec.structs.replace(LENS, distortion="equidistant"),
    ],
)
def test_cameras_project_as_colmap_does(camera):
    """Both ways, and a ray meets COLMAP's pixel half a pixel further right and below."""
    pycolmap = pytest.importorskip("pycolmap")
    model, parameters = colmap_camera(camera)
    size = (camera.width, camera.height)
    assert camera_of("", model, size, parameters) == camera
    theirs = pycolmap.Camera(model=model, params=parameters, width=size[0], height=size[1])
    points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.1, 2.0]])
    assert np.allclose(theirs.img_from_cam(points), camera.project(points) + 0.5, atol=1e-9)


def test_intrinsics_are_the_projects():
    assert read_intrinsics("500,510,320,236,-0.2,0.05,0.001,-0.002", 640, 480) == LENS


@pytest.mark.parametrize("text", ["585", "585,585,320", "a,b,c,d", "1,2,3,4,5", "nan,1,1,1", ""])
def test_other_intrinsics_are_refused(text):
    with pytest.raises(UsageError, match=r"intrinsics: expected fx,fy,cx,cy in pixels, or with"):
        read_intrinsics(text, 640, 480)


def test_similarities_are_found_again():
    """An exact similarity is recovered from points and from poses, two of which suffice."""
    true = similarity.Similarity(
        2.5, Rotation.from_rotvec([0.4, -1.2, 0.3]).as_quat(), np.array([3.0, -2.0, 9.0])
    )
    poses = random_poses(6)
    moved = true.poses(poses)
    assert np.allclose(
        true.points(poses[:, :3]),
        2.5 * Rotation.from_quat(true.rotation).apply(poses[:, :3]) + true.translation,
    )
    for found in (
        similarity.between_points(poses[:, :3], moved[:, :3]),
        similarity.between_poses(poses[:2], moved[:2]),
    ):
        assert np.allclose(found.poses(poses), moved, atol=1e-9)


def test_noisy_similarity_is_that_of_an_oracle():
    pycolmap = pytest.importorskip("pycolmap")
    source = RNG.normal(size=(30, 3))
    target = 0.3 * source[:, [1, 2, 0]] + RNG.normal(0, 0.05, (30, 3)) + 4.0
    ours, theirs = (
        similarity.between_points(source, target),
        pycolmap.estimate_sim3d(source, target),
    )
    assert ours.scale == pytest.approx(theirs.scale, rel=1e-9)
    assert np.allclose(quaternion_to_matrix(ours.rotation), theirs.rotation.matrix(), atol=1e-9)
    assert np.allclose(ours.translation, theirs.translation, atol=1e-9)


# --------------------------------------------------------------------------------------- scale


def seen_square(edge, views=5, unit=1.0):
    """A map of cameras about a square tag of ``edge`` metres, in units of ``unit`` metres."""
    square = edge * (np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) - [0.5, 0.5, 0.0])
    poses, sightings = [], []
    for row, angle in enumerate(np.linspace(-0.6, 0.6, views)):
        turn = Rotation.from_rotvec([0.2, angle, 0.1])
        centre = turn.apply([0.0, 0.0, -2.0])
        poses.append([*centre / unit, *turn.as_quat()])
        pixels = LENS.project(turn.inv().apply(square - centre))
        sightings.append(tags.Sighting(4, row, pixels))
    names = tuple(recordings.image_name("walk", row) for row in range(views))
    return Model(names, np.array(poses), (LENS,) * views, 0, 0.0, 0.0), sightings


@pytest.mark.parametrize("unit", [0.05, 1.0, 30.0])
def test_tags_give_the_metres_of_a_unit(unit):
    model, sightings = seen_square(0.2, unit=unit)
    found = scale.scale_of_tags(tags.locate_tags(model, sightings), 0.2)
    assert found.factor == pytest.approx(unit, rel=1e-6)
    assert found.spread < 1e-6


def test_a_view_that_contradicts_the_others_is_left_out():
    model, sightings = seen_square(0.2)
    sightings[2] = sightings[2]._replace(corners=sightings[2].corners + 15.0)
    (tag,) = tags.locate_tags(model, sightings)
    assert tag.views == 4
    assert tag.edge == pytest.approx(0.2, rel=1e-6)


def test_views_from_one_place_give_no_tag():
    model, sightings = seen_square(0.2)
    assert tags.locate_tags(model, sightings[:1]) == []
    same = model._replace(poses=np.repeat(model.poses[:1], 2, axis=0))
    assert tags.locate_tags(same, [sightings[0], sightings[0]._replace(row=1)]) == []
    with pytest.raises(SourceError, match="found none; show it longer and larger"):
        scale.scale_of_tags([], 0.2)


def test_several_tags_give_the_median_and_their_spread():
    found = [tags.Tag(n, 3, edge, (edge,) * 4, 0.1) for n, edge in enumerate([1.0, 1.25, 2.0])]
    result = scale.scale_of_tags(found, 0.5)
    assert result.factor == pytest.approx(0.4)
    assert result.spread == pytest.approx((0.5 - 0.25) / 2 / 0.4)


def test_a_distance_gives_the_scale():
    model, _ = seen_square(0.2)
    apart = np.linalg.norm(model.poses[0, :3] - model.poses[3, :3])
    found = scale.scale_of_distance(model, "walk/frame-000000", "walk/frame-000003", 7.0)
    assert found.factor * apart == pytest.approx(7.0)
    with pytest.raises(SourceError, match=r"^walk/frame-000009: expected a frame that the map"):
        scale.scale_of_distance(model, "walk/frame-000000", "walk/frame-000009", 7.0)


def test_known_poses_give_their_world():
    model, _ = seen_square(0.2)
    true = similarity.Similarity(3.0, Rotation.from_rotvec([0.1, 2.0, 0.0]).as_quat(), np.ones(3))
    moved = true.poses(model.poses)
    known = {model.names[row]: moved[row] for row in (1, 4)}
    found, aligned = scale.align_to_poses(model, known)
    assert found.factor == pytest.approx(3.0)
    assert np.allclose(aligned.poses(model.poses), moved, atol=1e-9)


def test_without_known_poses_the_first_camera_is_the_world():
    model, _ = seen_square(0.2)
    moved = scale.first_camera_world(model, 2.0).poses(model.poses)
    assert np.allclose(moved[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
    before, after = (np.linalg.norm(p[1, :3] - p[4, :3]) for p in (model.poses, moved))
    assert after == pytest.approx(2.0 * before)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a/frame-1 0 0 0 0 0 0 1\n", r"poses.txt: expected the poses of two or more frames"),
        ("# x\na/frame-1 0 0 0 0 0 0 2\n", r"poses.txt:2: expected VIDEO/frame-NNNNNN tx ty tz"),
        ("frame-1 0 0 0 0 0 0 1\n", r"poses.txt:1: frame: expected VIDEO/frame-NNNNNN, found"),
        ("a/frame-1 0 0 0 0 0 0 1\n" * 2, r"poses.txt:2: expected each frame once, found a/frame"),
        ("a/frame-1 0 0 x 0 0 0 1\n", r"poses.txt:1: expected VIDEO/frame-NNNNNN tx ty tz"),
    ],
)
def test_bad_known_poses_are_refused_with_their_line(tmp_path, text, expected):
    file = tmp_path / "poses.txt"
    file.write_text(text)
    with pytest.raises(UsageError, match=expected):
        scale.read_known_poses(file)


def test_gaps_are_runs_of_unplaced_frames():
    assert gaps([0, 4, 9, 12, 20], {4, 12}) == (Gap(0, 0, 1), Gap(9, 9, 1), Gap(20, 20, 1))
    assert gaps([0, 4, 9, 12], {0}) == (Gap(4, 12, 3),)
    assert gaps([0, 4], {0, 4}) == ()


# ----------------------------------------------------------------------------------- resumption

WALK = recordings.Recording("walk", "walk.mp4", (1, 2, 3))


def stages_of(scene, found=(WALK,)):
    return stages.Stages(stages.Layout(scene), list(found))


def test_stages_done_are_skipped_and_other_options_repeat_later_ones(tmp_path, capsys):
    layout = stages.Layout(tmp_path / "scene")
    state = stages_of(layout.scene)
    for name in ("frames", "features", "matching"):
        assert state.begin(name, "a")
        state.end(name)
    layout.database.write_bytes(b"x")
    again = stages_of(layout.scene)
    assert [again.begin(name, "a") for name in ("frames", "features")] == [False, False]
    assert again.begin("matching", "a") is False
    assert again.begin("mapping", "a")
    other = stages_of(layout.scene)
    assert other.begin("frames", "a") is False
    assert capsys.readouterr().err == ""
    assert other.begin("features", "b")
    assert not layout.database.exists()
    assert "features, matching, mapping was done with other options" in capsys.readouterr().err
    assert other.begin("matching", "a")


def test_an_interrupted_stage_goes_on(tmp_path):
    layout = stages.Layout(tmp_path / "scene")
    assert stages_of(layout.scene).begin("frames", "a")
    layout.frames.write_bytes(b"half")
    assert stages_of(layout.scene).begin("frames", "a")
    assert layout.frames.exists()


def test_other_recordings_and_other_folders_are_refused(tmp_path):
    scene = tmp_path / "scene"
    stages_of(scene)
    other = msgspec.structs.replace(WALK, name="run")
    with pytest.raises(UsageError, match=r"expected the recordings walk that it was begun with"):
        stages_of(scene, [WALK, other])
    changed = msgspec.structs.replace(WALK, identity=(9, 9, 9))
    with pytest.raises(UsageError, match=r"^walk\.mp4: has changed since .* choose a new folder$"):
        stages_of(scene, [changed])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"found something else; choose another folder"):
        stages_of(tmp_path / "mine")


def ends_badly(how, progress):
    """A task that fails as COLMAP may."""
    import os

    if how == "abort":
        os.abort()
    raise RuntimeError("SQLite error: database or disk is full")


@pytest.mark.parametrize(
    ("how", "kind", "expected"),
    [
        ("abort", SourceError, "COLMAP ended with exit code -6"),
        ("full", SinkError, "the disk is full; free some space and repeat the command"),
    ],
)
def test_a_dead_process_is_a_typed_error(tmp_path, how, kind, expected):
    pytest.importorskip("pycolmap")
    layout = stages.Layout(tmp_path)
    layout.work.mkdir()
    with pytest.raises(kind, match=expected):
        in_process(layout, partial(ends_badly, how), ignore)


# ------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"step": 0.0}, "step: expected up to 1 image width, found 0"),
        ({"most": 1}, "frames: expected two or more, found 1"),
        ({"tag_size_m": -1.0}, "tag size: expected metres above 0, found -1"),
        (
            {"tag_size_m": 0.1, "distance": ("a/frame-0", "a/frame-1", 1.0)},
            "scale: expected one source, found --tag-size and --distance",
        ),
        (
            {"distance": ("a/frame-0", "a/frame-000000", 1.0)},
            "distance: expected two different frames and metres above 0",
        ),
        (
            {"distance": ("b/frame-0", "a/frame-1", 1.0)},
            "b/frame-0: expected a frame of a, found another recording",
        ),
        ({"distance": ("frame-0", "a/frame-1", 1.0)}, "frame: expected VIDEO/frame-NNNNNN"),
    ],
)
def test_options_are_refused_before_anything_is_written(tmp_path, options, expected):
    pytest.importorskip("pycolmap")
    (tmp_path / "a").mkdir()
    cv2.imwrite(str(tmp_path / "a" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(UsageError, match=expected):
        reconstruct([str(tmp_path / "a")], tmp_path / "scene", Options(**options), ignore)
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (
            {},
            r"walk: expected two or more frames 0\.04 image widths of motion apart .* found 1 of 3",
        ),
        ({"intrinsics": "585,585"}, "walk: expected two or more frames"),
        ({"distance": ("walk/frame-0", "walk/frame-1", 1.0), "intrinsics": "5"}, "intrinsics: exp"),
        (
            {"distance": ("walk/frame-0", "walk/frame-9", 1.0)},
            "expected a readable frame of 0 to 2",
        ),
    ],
)
def test_recordings_that_cannot_be_used_leave_no_scene(tmp_path, options, expected):
    pytest.importorskip("pycolmap")
    (tmp_path / "walk").mkdir()
    for number in range(3):
        cv2.imwrite(str(tmp_path / "walk" / f"{number}.png"), np.zeros((48, 64, 3), np.uint8))
    scene = tmp_path / "scene"
    with pytest.raises((SourceError, UsageError), match=expected):
        reconstruct([str(tmp_path / "walk")], scene, Options(**options), ignore)
    assert not scene.exists()


def test_recordings_are_named_once_and_cameras_refused(tmp_path):
    for parent in ("one", "two"):
        (tmp_path / parent / "my walk").mkdir(parents=True)
        cv2.imwrite(str(tmp_path / parent / "my walk" / "0.png"), np.zeros((8, 8, 3), np.uint8))
    paths = [str(tmp_path / parent / "my walk") for parent in ("one", "two")]
    found = recordings.find_recordings(paths)
    assert [each.name for each in found] == ["my-walk", "my-walk-2"]
    with pytest.raises(UsageError, match="found a camera"):
        recordings.find_recordings(["0"])
    with pytest.raises(SourceError, match="expected a video file or a folder of images, found"):
        recordings.find_recordings([str(tmp_path / "three")])


def test_one_recording_has_one_image_size(tmp_path):
    for name, size in (("0", (48, 64, 3)), ("1", (64, 48, 3))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros(size, np.uint8))
    (recording,) = recordings.find_recordings([str(tmp_path)])
    with pytest.raises(SourceError, match=r"images of 64x48 pixels like the first, found 48x64 in"):
        recordings.measure(recording, tmp_path / "motion.json", ignore)


# ---------------------------------------------------------------------------------- end to end


WAY = Options(tag_size_m=0.2, intrinsics="292.5,292.5,159.5,119.5")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """Ten images of the room with a tag, their true poses, and their reconstruction."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("walked")
    dataset = open_dataset("synthetic:room,flights=1,frames=140,size=320x240,tag=0.2")
    rows = list(range(0, 140, 14))
    (folder / "walk").mkdir()
    for row in rows:
        cv2.imwrite(str(folder / "walk" / f"{row}.png"), dataset.read_image(row))
    report = reconstruct([str(folder / "walk")], folder / "scene", WAY, ignore)
    return folder, dataset.poses[rows], report


def test_a_rendered_walk_becomes_a_metric_map(walked):
    """All ten images are placed, metres within 1 %."""
    folder, true, report = walked
    scene = folder / "scene"
    assert report.registered == 1.0
    assert report.unit == "metres"
    assert report.doubts == ()
    assert msgspec.json.decode((scene / "report.json").read_bytes(), type=Report) == report
    assert "map: 10 of 10 images placed (100.0%)" in "\n".join(report_lines(report))
    model = read_model(scene / "sparse" / "0")
    assert model.names == tuple(recordings.image_name("walk", number) for number in range(10))
    assert all((scene / "images" / name).is_file() for name in model.names)
    found = similarity.between_points(model.poses[:, :3], true[:, :3])
    assert found.scale == pytest.approx(1.0, abs=0.01)
    errors = np.linalg.norm(found.points(model.poses[:, :3]) - true[:, :3], axis=1)
    assert np.median(errors) < 0.005


def test_a_scene_is_a_data_set_that_keeps_its_points(walked):
    folder, _, report = walked
    found = open_dataset(f"colmap:{folder / 'scene'}")
    assert len(found) == 10
    assert found.intrinsics == (292.5, 292.5, 159.5, 119.5)
    assert np.allclose(found.poses, read_model(folder / "scene" / "sparse" / "0").poses, atol=1e-9)
    pycolmap = pytest.importorskip("pycolmap")
    kept = pycolmap.Reconstruction(folder / "scene" / "sparse" / "0")
    assert kept.num_points3D() == report.points > 300


def test_another_scale_reads_the_finished_map(walked, tmp_path):
    folder, true, report = walked
    scene = shutil.copytree(folder / "scene", tmp_path / "scene")
    told = []
    ends = ("walk/frame-000000", "walk/frame-000009")
    metres = float(np.linalg.norm(true[0, :3] - true[9, :3]))
    other = msgspec.structs.replace(WAY, tag_size_m=None, distance=(*ends, metres))
    again = reconstruct([str(folder / "walk")], scene, other, lambda *stage: told.append(stage))
    assert told == []
    assert again.scale.factor == pytest.approx(report.scale.factor, rel=0.01)


@pytest.mark.parametrize(
    ("damaged", "stage", "expected"),
    [
        ("model/images.bin", "mapping", "model: expected the map, found damaged files; repeat"),
        ("mapping.json", "mapping", "model: expected the map, found damaged files; repeat"),
        ("database.db", "features", "expected the keypoints, found damaged files; repeat"),
    ],
)
def test_damaged_work_is_made_anew_by_the_next_call(walked, tmp_path, damaged, stage, expected):
    folder, _, _ = walked
    scene = shutil.copytree(folder / "scene", tmp_path / "scene")
    (scene / "work" / damaged).write_bytes(b"damaged " * 999)
    with pytest.raises(SourceError, match=expected):
        reconstruct([str(folder / "walk")], scene, WAY, ignore)
    state = msgspec.json.decode((scene / "work" / "state.json").read_bytes())
    assert stage not in state["stages"]
    assert not (scene / "work" / damaged).exists()
