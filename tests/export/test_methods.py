"""CQR, CSP and MCQR from training to bundle: common behaviour, then each method's own."""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest
import torch

from cvo_edge import Odometer
from cvo_edge.bundle.format import Threshold
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError, UsageError
from cvo_edge.output.sinks import Sink
from cvo_edge.sets import scaled_distance
from cvo_export import publish as publishing
from cvo_export.bundles.observed import observe
from cvo_export.evaluate import evaluate, find_level, subset_indices, table
from cvo_export.networks.heads.cqr import CqrConfig
from cvo_export.networks.heads.csp import (
    Classes,
    CspConfig,
    CspLearner,
    best_temperatures,
    set_score,
)
from cvo_export.networks.heads.mcqr import McqrConfig
from cvo_export.networks.heads.point import PointNetwork
from cvo_export.networks.methods import TRAINABLE
from cvo_export.plot import plot, track
from cvo_export.publish import publish
from cvo_export.training import loop as training
from cvo_export.training.configure import configure
from cvo_export.training.loop import train
from cvo_export.training.run import load_run

from .conftest import DATASET, ignore_progress, tiny_config
from .test_train import InterruptedTrainingError, same_weights, stopping_after

CONFIGS = {
    "cqr": CqrConfig(trees=20, components=8, forest_copies=1),
    "csp": CspConfig(classes=12, label_sigma=1.5),
    "mcqr": McqrConfig(components=8, rays=24, augmentation="predictions", passes=3),
}


@pytest.fixture(scope="module", params=list(CONFIGS))
def method(request):
    return request.param


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    made = {}

    def of(method):
        if method not in made:
            folder = tmp_path_factory.mktemp("runs") / method
            config = tiny_config(head=CONFIGS[method], steps=120)
            run = train(folder, config, ignore_progress)
            bundle = folder.with_name(method + "-bundle")
            publish(run, bundle, method)
            made[method] = (folder, run, bundle)
        return made[method]

    return of


# -- every method -------------------------------------------------------------------------------


def test_a_finished_run_is_read_back_and_publishes_the_same_bundle(runs, method, tmp_path):
    folder, run, bundle = runs(method)
    again = load_run(folder)
    assert same_weights(run, again)
    assert again.history == run.history
    publish(again, tmp_path / "again", method)
    first, second = read_bundle(bundle), read_bundle(tmp_path / "again")
    assert second.calibration.thresholds == first.calibration.thresholds


def test_an_interrupted_run_ends_as_if_it_never_was(runs, method, tmp_path):
    _, run, _ = runs(method)
    # This interrupts CQR in the second of its four lessons, and MCQR in the last of its five.
    calls = {"cqr": 50, "csp": 25, "mcqr": 170}[method]
    with pytest.raises(InterruptedTrainingError):
        train(
            tmp_path / "run",
            tiny_config(head=CONFIGS[method], steps=120),
            stopping_after(calls, "training"),
        )
    resumed = train(tmp_path / "run", tiny_config(head=CONFIGS[method], steps=120), ignore_progress)
    assert same_weights(run, resumed)
    assert run.history == resumed.history


def test_a_shared_cache_gives_the_same_features(tmp_path):
    # Runs share features only if their weights come from a file.
    from safetensors.torch import save_file

    from cvo_export.networks.backbone import Backbone

    config = tiny_config(steps=100)
    torch.manual_seed(5)
    body = Backbone(config.backbone, 48, 64).body
    save_file(body.state_dict(), tmp_path / "weights.safetensors")
    config = tiny_config(steps=100, weights=str(tmp_path / "weights.safetensors"))
    alone = train(tmp_path / "alone", config, ignore_progress)
    first = train(tmp_path / "first", config, ignore_progress, tmp_path / "cache")
    second = train(tmp_path / "second", config, ignore_progress, tmp_path / "cache")
    assert same_weights(alone, first)
    assert same_weights(first, second)
    assert len(list((tmp_path / "cache").iterdir())) == 1
    assert not (tmp_path / "first" / "features-0").exists()


def test_evaluation_is_that_of_the_odometer_frame_by_frame(runs, method):
    _, run, bundle = runs(method)
    report = evaluate(bundle, run.dataset, "test")
    level = find_level(report["levels"], 0.8, "marginal")
    covered, widths = [], []
    with Odometer.load(bundle, confidence=0.8) as odometer:
        for index in run.split.roles["test"].tolist():
            estimate = odometer.step(run.dataset.read_image(index))
            covered.append(estimate.covers(run.dataset.poses[index]))
            widths.append(estimate.conformal_set.width())
    np.testing.assert_allclose(level["coverage"], np.mean(covered, axis=0))
    np.testing.assert_allclose(level["mean_width"], np.mean(widths, axis=0))
    low, high = level["coverage_band"]
    assert low <= np.mean(level["coverage"]) <= min(1.0, high + 0.05)
    assert "\n".join(table(report)).count("joint ") >= 5


def test_backbones_that_learn_train_too(tmp_path, method):
    config = tiny_config(head=CONFIGS[method], fine_tune=1, steps=100)
    run = train(tmp_path / "run", config, ignore_progress)
    assert {entry.phase for entry in run.history} == {0, 1, 2}
    assert np.isfinite([entry.val_score for entry in run.history]).all()


def test_a_score_that_the_method_does_not_have_is_refused_with_those_it_has(runs, method, tmp_path):
    _, run, _ = runs(method)
    known = {"csp": "aps, lac, raps"}.get(method, "normalised, additive")
    with pytest.raises(UsageError, match=known):
        publish(run, tmp_path / "bundle", "other", score="other")
    assert not (tmp_path / "bundle").exists()


def test_bonferroni_is_recorded_and_is_the_marginal_rule_at_a_sixth(runs, method, tmp_path):
    _, run, _ = runs(method)
    if method == "mcqr":
        with pytest.raises(UsageError, match="one score for all six"):
            publish(run, tmp_path / "bundle", "b", joint="bonferroni")
        return
    calibration = publish(run, tmp_path / "bundle", "b", joint="bonferroni")
    assert calibration.calibration.joint == "bonferroni"
    # With 64 frames, the level 1 - 0.1/6 needs rank 64.
    joint = calibration.threshold(0.9, "joint")
    with Odometer.load(tmp_path / "bundle") as odometer:
        seen = observe(odometer, run.dataset, run.split.roles["cal"])
        scores = odometer.head.scores(seen.outputs, seen.point, seen.truth)
    assert joint.q_hat == tuple(scores[:, 0].max(axis=0).tolist())
    assert (
        find_level(evaluate(tmp_path / "bundle", run.dataset, "test")["levels"], 0.9, "joint")[
            "coverage_band"
        ]
        is None
    )


def test_a_picture_is_drawn(runs, method, tmp_path):
    _, run, bundle = runs(method)
    plot(bundle, run.dataset, tmp_path / "bands.png", scope="joint", confidence=0.8)
    assert (tmp_path / "bands.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["bands.png"]
    with pytest.raises(UsageError, match="out: expected a file"):
        plot(bundle, run.dataset, tmp_path / "bands.xyz")
    with pytest.raises(UsageError, match="sequence: expected one of"):
        plot(bundle, run.dataset, tmp_path / "other.png", sequence="no such")


def test_a_picture_shows_the_sets_that_are_evaluated(runs):
    _, run, bundle = runs("cqr")
    image = run.dataset.read_image(0)
    repeating = dataclasses.replace(run.dataset, read_image=lambda _: image)
    found = track(bundle, repeating)
    indices = subset_indices(read_calibration(bundle), run.dataset, "test")
    # Lines end where the next test frame is not the next frame of its recording.
    follows = (np.diff(indices) == 1) & (np.diff(run.dataset.sequence[indices]) == 0)
    np.testing.assert_array_equal(np.diff(found.parts) == 0, follows)
    drawn = found.estimates
    report = evaluate(bundle, repeating, "test")
    frames = report["frames"]
    assert frames["total"] == frames["bounded"] == len(drawn)
    assert found.proven == find_level(report["levels"], 0.9, "marginal")["statement"]
    assert all(np.isfinite(estimate.lower).all() for estimate in drawn)


def options(**changes):
    values = {
        "method": "cjp",
        "dataset": DATASET,
        "split": None,
        "seed": 0,
        "size": "64x48",
        "crop": "none",
        "backbone": "mobilenetv2_100",
        "weights": "none",
        "stages": "16",
        "grid": "3x4",
        "normalisation": None,
        "head": {},
    }
    return {**values, **changes}


def test_an_option_of_another_method_is_refused():
    with pytest.raises(
        UsageError, match=r"--trees is not an option of csp; its options are --classes, --labels"
    ):
        configure(**options(method="csp", head={"trees": 5}))
    assert configure(**options(method="cqr", head={"trees": 5, "classes": None})).head.trees == 5
    with pytest.raises(UsageError, match="noise: expected a method that trains a head on features"):
        configure(**options(method="scr", noise=0.5))
    assert configure(**options(copies=2, noise=0.0)) == configure(**options(copies=2))


def test_the_input_has_the_size_of_the_method_unless_another_is_given():
    sizes = {}
    for method in TRAINABLE:
        config = configure(**options(method=method, size=None))
        sizes[config.width, config.height] = sizes.get((config.width, config.height), 0) + 1
        # The cells of a stem are 16 pixels wide and high.
        if TRAINABLE[method].cells:
            assert config.width % 16 == config.height % 16 == 0
    assert sizes == {(192, 144): len(TRAINABLE) - 2, (256, 192): 2}
    config = configure(**options(method="scr", size="96x64"))
    assert (config.width, config.height) == (96, 64)


@pytest.mark.parametrize(
    ("method", "head", "match"),
    [
        ("cqr", {"quantiles": (0.9, 0.1)}, "0 < low < high < 1"),
        ("cqr", {"quantiles": (0.0, 0.9)}, "0 < low < high < 1"),
        ("cqr", {"trees": 0}, "--trees of cqr: expected `int` >= 1, found 0"),
        ("csp", {"classes": 1}, "classes"),
        ("mcqr", {"augmentation": "labels", "dropout": 0.0}, "dropout: expected more than 0"),
        ("mcqr", {"kappa": 0.0}, "kappa"),
        ("mcqr", {"passes": 5}, "passes: expected only with augmentation"),
        ("nothing", {}, "expected one of cjp, cqr, csp"),
    ],
)
def test_options_out_of_their_range_are_refused(method, head, match):
    with pytest.raises(UsageError, match=match):
        configure(**options(method=method, head=head))


# -- CQR ----------------------------------------------------------------------------------------


def test_the_graph_of_a_forest_equals_its_reference_on_every_frame(runs):
    _, run, bundle = runs("cqr")
    head = run.graph.head
    names = ["image"]
    blank = torch.zeros((1, 48, 64, 3), dtype=torch.uint8)
    before = Session(publishing.export_onnx(run.graph, [blank], names, head.output_names))
    after = Session(read_bundle(bundle).model_bytes)
    for index in range(0, len(run.dataset), 4):
        feed = {"image": run.dataset.read_image(index)[np.newaxis, :, :, ::-1].copy()}
        expected, found = head.completed_outputs(before.run(feed)), after.run(feed)
        for name, values in expected.items():
            np.testing.assert_array_equal(values, found[name])


def test_a_graph_that_differs_from_its_reference_is_not_published(runs, tmp_path, monkeypatch):
    _, run, _ = runs("cqr")
    other = run.graph.head.completed_outputs
    monkeypatch.setattr(
        run.graph.head,
        "completed_outputs",
        lambda outputs: {name: values + 1e-6 for name, values in other(outputs).items()},
    )
    with pytest.raises(GateError, match="equal its reference"):
        publish(run, tmp_path / "bundle", "wrong")
    assert not (tmp_path / "bundle").exists()


@pytest.mark.parametrize(
    "changes", [{"forest": "per_dof"}, {"residuals": "held_out", "components": 0}]
)
@pytest.mark.usefixtures("small_backbone")
def test_other_forests_train_and_publish(tmp_path, changes):
    head = CqrConfig(trees=5, leaf_size=4, forest_copies=0, **changes)
    run = train(tmp_path / "run", tiny_config(head=head, steps=100), ignore_progress)
    calibration = publish(load_run(tmp_path / "run"), tmp_path / "bundle", "forest")
    assert calibration.pose.rotation == "tangent_predicted"
    lessons = {entry.lesson for entry in run.history}
    held_out = changes.get("residuals") == "held_out"
    assert lessons == ({"cqr"} if held_out else {"cqr", "cqr-fold0", "cqr-fold1", "cqr-fold2"})


def test_two_sides_are_published_and_hold(runs, tmp_path):
    _, run, _ = runs("cqr")
    calibration = publish(run, tmp_path / "bundle", "two", sides="asymmetric", score="additive")
    entry = calibration.threshold(0.9, "marginal")
    assert None not in (*entry.q_hat, *entry.q_hat_upper)
    level = find_level(
        evaluate(tmp_path / "bundle", run.dataset, "test")["levels"], 0.9, "marginal"
    )
    assert level["coverage_band"] is None
    assert np.mean(level["coverage"]) > 0.8


def test_one_side_is_unbounded_and_its_frames_say_so(runs, tmp_path):
    _, run, _ = runs("cqr")
    publish(run, tmp_path / "bundle", "one", sides="upper")
    with Odometer.load(tmp_path / "bundle") as odometer:
        estimate = odometer.step(run.dataset.read_image(0))
    assert (estimate.lower == -np.inf).all()
    assert np.isfinite(estimate.upper).all()
    record = estimate.to_dict()["interval"]
    assert record["bounded"] is False
    assert record["lower"] == [None] * 6


def test_sides_belong_to_cqr_alone(runs, tmp_path):
    _, run, _ = runs("csp")
    with pytest.raises(UsageError, match="sides: expected symmetric"):
        publish(run, tmp_path / "bundle", "csp", sides="lower")


def test_offsets_about_a_prediction_still_have_an_implausible_rotation(runs):
    _, _, bundle = runs("cqr")
    pose = read_calibration(bundle).pose
    assert pose.rotation == "tangent_predicted"
    assert pose.reference_q_xyzw is not None
    assert max(pose.limits.highest[3:]) < np.pi


# -- MCQR ---------------------------------------------------------------------------------------


def test_the_graph_is_the_definition_step_by_step(runs):
    _, run, bundle = runs("mcqr")
    head, image = run.graph.head, run.dataset.read_image(int(run.split.roles["test"][0]))
    with Odometer.load(bundle) as odometer:
        seen = odometer.observe(image, 0)
    rgb = torch.from_numpy(image[np.newaxis, :, :, ::-1].copy())
    with torch.no_grad():
        features = run.graph.backbone(rgb)
        point = head.point(features)
        c = head.standardise(
            torch.cat([head.point.standardise(features) @ head.components, point], dim=1)
        )
        v = head.region.codebook(c, head.kappa)[0].double().numpy()
        local = head.region.scale(c)[0].double().numpy()
    unit = head.unit.double().numpy()
    origin = np.append(seen.pose[:3], [0.0, 0.0, 0.0])
    expected = origin + (v @ local.T) * unit
    np.testing.assert_allclose(seen.outputs["codebook"][0], expected, atol=1e-4)
    np.testing.assert_allclose(seen.outputs["scale"][0], unit[:, None] * local, atol=1e-4)


def test_contains_is_the_region_in_the_joint_scope_and_six_intervals_in_the_marginal_one(runs):
    _, run, bundle = runs("mcqr")
    indices = run.split.roles["test"].tolist()
    inside = {}
    for scope in ("marginal", "joint"):
        with Odometer.load(bundle, scope=scope, confidence=0.8) as odometer:
            for index in indices:
                estimate = odometer.step(run.dataset.read_image(index))
                truth = run.dataset.poses[index]
                held = estimate.contains(truth)
                inside.setdefault(scope, []).append(held)
                if scope == "marginal":
                    assert estimate.conformal_set.ellipsoids is None
                    assert held == estimate.covers(truth).all()
                else:
                    coordinates = estimate.chart.coordinates(truth, estimate.pose.to_array())
                    assert held == estimate.conformal_set.ellipsoids.contains(coordinates)
                    # The bounding box is larger than the region.
                    corner = 0.999 * estimate.upper + 0.001 * estimate.lower
                    assert estimate.conformal_set.covers(corner).all()
                    assert not estimate.conformal_set.contains(corner)
    report = evaluate(bundle, run.dataset, "test")
    for scope, held in inside.items():
        level = find_level(report["levels"], 0.8, scope)
        assert level["joint_coverage"] == pytest.approx(np.mean(held))


def test_the_volume_is_the_share_of_the_hull_that_lies_in_the_region(runs):
    _, run, bundle = runs("mcqr")
    generator = np.random.default_rng(0)
    shares = []
    with Odometer.load(bundle, scope="joint") as odometer:
        deviation = np.array(odometer.calibration.pose.standard_deviation)
        for index in run.split.roles["test"].tolist():
            region = odometer.step(run.dataset.read_image(index)).conformal_set
            points = generator.uniform(region.lower, region.upper, (4000, 6))
            found = region.ellipsoids
            held = np.mean(scaled_distance(found.centres, found.scale, points) <= found.radius)
            shares.append(held * np.prod((region.upper - region.lower) / deviation))
    level = find_level(evaluate(bundle, run.dataset, "test")["levels"], 0.9, "joint")
    assert level["joint_volume"]["mean"] == pytest.approx(np.mean(shares), rel=0.1)


def test_records_have_the_region_on_request_only(runs, tmp_path):
    _, run, bundle = runs("mcqr")
    image = run.dataset.read_image(0)
    with Odometer.load(bundle, scope="joint", confidence=0.8) as odometer:
        assert odometer.has_region
        estimate = odometer.step(image)
    assert "region" not in estimate.to_dict()["interval"]
    with Sink(str(tmp_path / "out.jsonl"), "jsonl", region=True) as sink:
        sink.write(estimate)
    region = json.loads((tmp_path / "out.jsonl").read_text())["interval"]["region"]
    centres, scale = np.array(region["centres"]), np.array(region["scale"])
    reach = region["radius"] * np.linalg.norm(scale, axis=1)
    np.testing.assert_allclose(centres.max(axis=0) + reach, estimate.upper)
    np.testing.assert_allclose(centres.min(axis=0) - reach, estimate.lower)
    with pytest.raises(UsageError, match="expected the format jsonl"):
        Sink(str(tmp_path / "out.csv"), "csv", region=True)
    with Odometer.load(bundle) as odometer:
        assert not odometer.has_region


@pytest.mark.usefixtures("small_backbone")
def test_passes_are_rows_of_the_region_and_real_frames_are_what_is_counted(tmp_path, monkeypatch):
    seen = {}
    learn = training._Trainer.learn

    def spy(self, name, build, rows=None, examples=None, **more):
        if examples is not None:
            seen[name] = examples.x.shape, examples.val_x.shape
        return learn(self, name, build, rows, examples, **more)

    monkeypatch.setattr(training._Trainer, "learn", spy)
    head = McqrConfig(components=4, rays=8, augmentation="predictions", passes=3)
    run = train(tmp_path / "run", tiny_config(head=head, steps=100, copies=1), ignore_progress)
    frames = run.split.roles["train"].size + run.split.roles["fit"].size
    # Training has three passes of each of two copies; val has no passes.
    assert seen == {"mcqr-region": ((3 * 2, frames, 10), (run.split.roles["val"].size, 10))}
    calibration = publish(run, tmp_path / "bundle", "passes")
    assert calibration.calibration.n == run.split.roles["cal"].size
    chosen = calibration.provenance.options
    assert chosen["chosen.kappa"] == pytest.approx(float(run.graph.head.kappa))
    assert chosen["chosen.points"] == calibration.method_parameters["points"]


@pytest.mark.parametrize("method", ["cqr", "mcqr"])
def test_more_components_than_there_are_is_refused_before_any_lesson(tmp_path, method):
    config = tiny_config(head=type(CONFIGS[method])(components=4000))
    with pytest.raises(UsageError, match="components: expected at most"):
        train(tmp_path / "run", config, ignore_progress)
    assert not list((tmp_path / "run").glob("checkpoint*"))


def test_the_mean_of_many_passes_is_the_network_itself():
    # Dropout is before a linear layer, so its expectation is the deterministic output.
    torch.manual_seed(0)
    network = PointNetwork(30, 6, (16, 12), 0.1, dropout=0.3).eval()
    features = torch.randn(5, 30)
    with torch.no_grad():
        drawn = network.passes(features, 4000, torch.Generator().manual_seed(1))
        assert drawn.shape == (4000, 5, 6)
        error = drawn.std(dim=0) / np.sqrt(4000)
        assert ((drawn.mean(dim=0) - network(features)).abs() < 5 * error + 1e-6).all()
        assert (drawn.std(dim=0) > 0).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"augmentation": "labels", "passes": 2, "kappa": 1.3, "components": 0},
        {"scale": "constant", "residuals": "held_out"},
    ],
)
@pytest.mark.usefixtures("small_backbone")
def test_other_regions_train_and_publish(tmp_path, changes):
    head = McqrConfig(**{"components": 4, "rays": 12, **changes})
    config = tiny_config(head=head, steps=100, copies=1)
    run = train(tmp_path / "run", config, ignore_progress)
    calibration = publish(load_run(tmp_path / "run"), tmp_path / "bundle", "region")
    assert calibration.pose.rotation == "tangent_predicted"
    assert 1 <= calibration.method_parameters["points"] <= 1 + 3 * 12
    held_out = changes.get("residuals") == "held_out"
    folds = set() if held_out else {"mcqr-fold0", "mcqr-fold1", "mcqr-fold2"}
    assert {entry.lesson for entry in run.history} == {"mcqr", "mcqr-region", *folds}
    assert run.best.lesson == "mcqr"
    if "kappa" in changes:
        assert float(run.graph.head.kappa) == pytest.approx(1.3)


# -- CSP ----------------------------------------------------------------------------------------


def test_probabilities_of_the_graph_add_up_to_one(runs):
    _, run, bundle = runs("csp")
    with Odometer.load(bundle) as odometer:
        seen = observe(odometer, run.dataset, run.split.roles["test"])
    np.testing.assert_allclose(seen.outputs["probabilities"].sum(axis=-1), 1.0, atol=1e-5)


def test_bands_reach_the_record_the_csv_and_contains(runs, tmp_path):
    _, run, bundle = runs("csp")
    with Odometer.load(bundle) as odometer:
        frames = [run.dataset.read_image(i) for i in run.split.roles["test"].tolist()]
        estimates = list(odometer.stream(frames))
    gapped = next(e for e in estimates if any(len(row) > 1 for row in e.bands))
    dof = next(d for d in range(6) if len(gapped.bands[d]) > 1)
    record = json.loads(json.dumps(gapped.to_dict(), default=list))["interval"]
    assert record["bands"] == [[list(band) for band in row] for row in gapped.bands]
    assert record["lower"][dof] == record["bands"][dof][0][0]
    assert record["upper"][dof] == record["bands"][dof][-1][1]
    with Sink(str(tmp_path / "out.csv"), "csv") as sink:
        sink.write(gapped)
    (row,) = csv.DictReader(io.StringIO((tmp_path / "out.csv").read_text()))
    cell = row[f"{gapped.chart.dof[dof]}_bands"]
    parsed = [tuple(map(float, band.split(":"))) for band in cell.split()]
    assert parsed == [tuple(band) for band in gapped.bands[dof]]
    middle = [0.5 * (row[0][0] + row[0][1]) for row in gapped.bands]
    in_gap = list(middle)
    in_gap[dof] = 0.5 * (gapped.bands[dof][0][1] + gapped.bands[dof][1][0])
    assert gapped.conformal_set.covers(middle).all()
    assert not gapped.conformal_set.covers(in_gap)[dof]


def test_boxes_are_the_product_of_the_position_bands(runs):
    _, run, bundle = runs("csp")
    with Odometer.load(bundle) as odometer:
        estimate = odometer.step(run.dataset.read_image(int(run.split.roles["test"][0])))
    boxes = estimate.position_boxes()
    assert len(boxes) == np.prod([len(row) for row in estimate.bands[:3]])
    volume = np.prod(boxes[:, :, 1] - boxes[:, :, 0], axis=1).sum()
    assert volume == pytest.approx(np.prod(estimate.conformal_set.width()[:3]))


def test_the_report_counts_classes_and_pieces(runs):
    _, run, bundle = runs("csp")
    level = find_level(evaluate(bundle, run.dataset, "test")["levels"], 0.8, "marginal")
    assert all(1.0 <= size <= 12.0 for size in level["set_size"])
    assert all(0.0 <= share <= level["disjoint_frames"] for share in level["disjoint_share"])


@pytest.mark.usefixtures("small_backbone")
def test_the_papers_labels_train(tmp_path):
    head = CspConfig(classes=6, labels="one_hot")
    run = train(tmp_path / "run", tiny_config(head=head, steps=100), ignore_progress)
    assert publish(run, tmp_path / "bundle", "lac", score="lac").calibration.score == "lac"


@pytest.mark.usefixtures("small_backbone")
def test_val_chooses_among_widths_of_the_labels(tmp_path):
    run = train(
        tmp_path / "run", tiny_config(head=CspConfig(classes=8), steps=100), ignore_progress
    )
    assert len({entry.lesson for entry in run.history}) == 3


def test_classes_hold_equal_shares_and_tile_a_wider_workspace():
    y = np.random.default_rng(0).standard_normal((1000, 6))
    classes = Classes.cut(y, 10)
    index = classes.index(torch.from_numpy(y)).numpy()
    for dof in range(6):
        counts = np.bincount(index[:, dof], minlength=10)
        assert counts.min() >= 99
        assert counts.max() <= 101
    edges = classes.edges.numpy()
    assert (np.diff(edges, axis=1) > 0).all()
    spread = np.ptp(y, axis=0)
    np.testing.assert_allclose(edges[:, 0], y.min(axis=0) - 0.1 * spread)
    np.testing.assert_allclose(edges[:, -1], y.max(axis=0) + 0.1 * spread)


def test_a_degree_of_freedom_that_repeats_has_fewer_classes():
    generator = np.random.default_rng(0)
    y = generator.standard_normal((300, 6))
    y[:, 2] = generator.integers(0, 3, 300)
    classes = Classes.cut(y, 8)
    assert classes.used.sum(dim=1).tolist()[2] < 8
    assert classes.count == 8
    index = classes.index(torch.from_numpy(y)).numpy()
    assert classes.used.numpy()[2][index[:, 2]].all()
    learner = CspLearner(4, CspConfig(), classes, 1.5)
    labels = learner.labels(torch.from_numpy(y).float())
    np.testing.assert_allclose(labels.sum(dim=-1).numpy(), 1.0, atol=1e-5)
    assert (labels[:, 2][:, ~classes.used[2]] == 0).all()
    probabilities = torch.softmax(learner.network.eval()(torch.zeros(3, 4)), dim=-1)
    assert (probabilities[:, 2][:, ~classes.used[2]] == 0).all()


def test_fewer_poses_than_classes_leave_no_class_without_a_place():
    generator = np.random.default_rng(0)
    still = generator.standard_normal((260, 6))
    still[:160] = still[0]  # a camera at rest
    for y in (generator.standard_normal((60, 6)), still, np.repeat(still[150:170], 10, axis=0)):
        classes = Classes.cut(y, 128)
        medians, edges = classes.medians.numpy(), classes.edges.numpy()
        used = classes.used.numpy()
        assert np.isfinite(medians).all()
        assert ((edges[:, :-1] <= medians) & (medians <= edges[:, 1:]))[used].all()


def test_what_val_judges_is_what_the_runtime_gives(runs):
    _, run, bundle = runs("csp")
    classes, target = run.graph.head.network.classes, run.target
    with Odometer.load(bundle) as odometer:
        seen = observe(odometer, run.dataset, run.split.roles["val"])
        # While a network is trained, nothing scales its sets.
        head = odometer.head.scaled(None)
    scores = head.scores(seen.outputs, seen.point, seen.truth)
    q_hat = [conformal_quantile(scores[:, 0, dof], 0.9) for dof in range(6)]
    entry = Threshold(confidence=0.9, scope="marginal", q_hat=tuple(q_hat), q_hat_upper=None)
    regions = seen.sets(head, entry)
    width = np.array([region.width() for region in regions])
    distance = np.array([r.distance(y) for r, y in zip(regions, seen.truth, strict=True)])
    expected = interval_score(width, distance, 0.1) / target.std
    y = (seen.truth - target.mean) / target.std
    found = set_score(classes, seen.outputs["probabilities"].astype(np.float64), y)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_the_network_that_val_chose_is_named_in_the_bundle(runs):
    _, run, bundle = runs("csp")
    assert read_calibration(bundle).provenance.options["lesson"] == run.best.lesson
    assert run.best.val_score == min(entry.val_score for entry in run.history)


def test_position_counts_classes_from_middle_to_middle():
    y = np.random.default_rng(0).standard_normal((500, 6))
    classes = Classes.cut(y, 10)
    middles = 0.5 * (classes.edges[:, 1:] + classes.edges[:, :-1])
    for number in range(10):
        position = classes.position(middles[:, number][None].float())
        np.testing.assert_allclose(position.numpy(), number, atol=1e-4)


def test_the_temperature_mends_logits_that_are_too_sharp():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(4000, 6, 5, generator=generator).double()
    index = torch.distributions.Categorical(logits=logits).sample()
    found = best_temperatures(3.0 * logits, index)
    np.testing.assert_allclose(found.numpy(), 3.0, rtol=0.15)
