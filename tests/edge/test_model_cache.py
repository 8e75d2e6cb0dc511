"""The model cache: identical numbers, no changed byte, and no failure prevents a run."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.engine.model_cache import (
    ENTRY_FILE,
    GRAPH_FILE,
    SEEN_FILE,
    WEIGHTS_FILE,
    CachedModel,
    ModelCache,
)
from cvo_edge.engine.own_files import file_digests
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.engine.session import Session
from cvo_edge.errors import BundleMismatchError, ModelError, UsageError
from cvo_edge.files import untrusted
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.programs.inspect import cache_lines

CVO_EDGE = [sys.executable, "-c", "from cvo_edge.__main__ import main; main()"]


@pytest.fixture
def cache(tmp_path: Path) -> ModelCache:
    return ModelCache(tmp_path / "cache")


def entry_folder(cache: ModelCache) -> Path:
    (folder,) = cache.folder.iterdir()
    return folder


@pytest.mark.parametrize("method", ["cjp", "cqr", "csp", "mcqr", "cjp-int8", "scr", "scr-int8"])
def test_a_prepared_model_computes_the_very_same(method, bundle_dir, clip_dir, cache):
    folder = bundle_dir.with_name(f"synthetic-room-{method}")
    with (
        Odometer.load(folder) as plain,
        Odometer.load(folder, cache=cache) as built,
        Odometer.load(folder, cache=cache) as found,
    ):
        for frame in list(open_source(str(clip_dir)))[:3]:
            expected, *others = (o.observe(frame.image, 0) for o in (plain, built, found))
            assert expected.fault is None
            for other in others:
                for name, values in expected.outputs.items():
                    assert np.array_equal(values, other.outputs[name])
    assert isinstance(read_bundle(folder, cache=cache).model, CachedModel)


def test_what_is_prepared_is_the_same_whatever_a_calibration_says_of_it(
    artifacts_dir, tmp_path, monkeypatch
):
    """A model has one entry: a bundle that declares it float32 must not spoil the entry."""
    bundle = read_bundle(artifacts_dir / "synthetic-room-cjp-int8")
    # Simulate a processor on which the precision matters.
    monkeypatch.setattr("cvo_edge.engine.session.saturates", lambda: True)
    graphs = []
    for precision in ("int8", "fp32"):
        folder = tmp_path / precision
        folder.mkdir()
        model = msgspec.structs.replace(bundle.calibration.model, precision=precision)
        Session(bundle.model_bytes, 1, model, keep_in=folder)
        graphs.append((folder / GRAPH_FILE).read_bytes())
    assert graphs[0] == graphs[1]


@pytest.mark.parametrize("file", [GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE])
def test_a_changed_byte_is_never_used(file, bundle_dir, bundle, cache):
    sha256 = bundle.calibration.model.sha256
    read_bundle(bundle_dir, cache=cache)
    path = entry_folder(cache) / file
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert cache.find(sha256) is None
    assert not path.exists()
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)
    assert cache.find(sha256) is not None


def make_folder(path: Path) -> None:
    path.mkdir()


def make_dangling_link(path: Path) -> None:
    path.symlink_to("/nonexistent")


@pytest.mark.parametrize("make", [os.mkfifo, make_folder, make_dangling_link])
@pytest.mark.parametrize("file", [GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE, SEEN_FILE])
def test_what_is_no_file_is_neither_waited_for_nor_followed(file, make, bundle_dir, bundle, cache):
    read_bundle(bundle_dir, cache=cache)
    path = entry_folder(cache) / file
    path.unlink(missing_ok=True)
    make(path)
    cache_lines(cache)
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)
    assert cache.find(bundle.calibration.model.sha256) is not None


def test_what_is_prepared_is_of_this_model_and_this_engine(bundle_dir, bundle, cache):
    """Two bundles may agree in all names and shapes; neither runs with the other's model."""
    cached = read_bundle(bundle_dir, cache=cache).model
    eight = read_bundle(bundle_dir.with_name("synthetic-room-cjp-int8")).calibration
    elsewhere = msgspec.structs.replace(
        bundle.calibration,
        model=msgspec.structs.replace(bundle.calibration.model, provider="openvino"),
    )
    for calibration in (eight, elsewhere):
        with pytest.raises(BundleMismatchError, match="cached model: expected"):
            Odometer(Bundle.of(calibration, cached))


def test_verify_asks_the_prepared_model_too(bundle_dir, cache, monkeypatch):
    """The entry has other weights and matching digests."""
    read_bundle(bundle_dir, cache=cache)
    monkeypatch.setenv("CVO_EDGE_CACHE", str(cache.folder))
    command = [*CVO_EDGE, "verify", str(bundle_dir)]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0
    weights = entry_folder(cache) / WEIGHTS_FILE
    values = np.fromfile(weights, np.float32)
    (values * 1.5).tofile(weights)
    entry = json.loads((entry_folder(cache) / ENTRY_FILE).read_bytes())
    entry["weights_sha256"] = file_digests(weights)
    (entry_folder(cache) / ENTRY_FILE).write_text(json.dumps(entry))
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 8
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("file", [GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE])
def test_a_missing_file_is_a_missing_entry(file, bundle_dir, bundle, cache):
    read_bundle(bundle_dir, cache=cache)
    (entry_folder(cache) / file).unlink()
    assert cache.find(bundle.calibration.model.sha256) is None


@pytest.mark.parametrize("key", ["model_sha256", "engine", "processor"])
def test_an_entry_of_something_else_is_not_used(key, bundle_dir, bundle, cache):
    read_bundle(bundle_dir, cache=cache)
    path = entry_folder(cache) / ENTRY_FILE
    entry = json.loads(path.read_bytes())
    path.write_text(json.dumps({**entry, key: "of another"}))
    assert cache.find(bundle.calibration.model.sha256) is None


def test_a_swapped_model_is_refused_whatever_the_cache_holds(copied_bundle, cache):
    read_bundle(copied_bundle, cache=cache)
    path = copied_bundle / "model.onnx"
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(BundleMismatchError, match=hashlib.sha256(path.read_bytes()).hexdigest()):
        Odometer.load(copied_bundle, cache=cache)


@pytest.fixture
def settled(monkeypatch):
    """Make files count as settled immediately."""
    monkeypatch.setattr("cvo_edge.engine.model_cache._SETTLED_NS", 0)


def test_the_digest_of_an_unchanged_model_is_taken_once(copied_bundle, cache, settled, monkeypatch):
    read_bundle(copied_bundle, cache=cache)
    read_bundle(copied_bundle, cache=cache)
    taken = []
    monkeypatch.setattr("cvo_edge.engine.loading.check_model_file", lambda *_: taken.append(1))
    read_bundle(copied_bundle, cache=cache)
    assert not taken
    (copied_bundle / "model.onnx").touch()
    read_bundle(copied_bundle, cache=cache)
    assert taken


def test_a_model_of_the_same_size_and_times_is_refused(copied_bundle, cache, settled):
    for _ in range(2):
        read_bundle(copied_bundle, cache=cache)
    path = copied_bundle / "model.onnx"
    before = path.stat()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    with pytest.raises(BundleMismatchError):
        read_bundle(copied_bundle, cache=cache)


def test_a_file_that_has_just_changed_is_not_remembered(copied_bundle, cache):
    # A date in the far future counts as a recent change however long loading takes.
    os.utime(copied_bundle / "model.onnx", (2**32, 2**32))
    for _ in range(2):
        read_bundle(copied_bundle, cache=cache)
    assert not (entry_folder(cache) / SEEN_FILE).exists()


def test_a_link_in_place_of_a_model_is_refused(copied_bundle, cache, settled, tmp_path):
    for _ in range(2):
        read_bundle(copied_bundle, cache=cache)
    path = copied_bundle / "model.onnx"
    path.rename(tmp_path / "elsewhere.onnx")
    path.symlink_to(tmp_path / "elsewhere.onnx")
    with pytest.raises(ModelError):
        read_bundle(copied_bundle, cache=cache)


def test_a_folder_that_others_may_write_to_is_not_used(bundle_dir, cache):
    read_bundle(bundle_dir, cache=cache)
    cache.folder.chmod(0o777)
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, bytes)
    cache.folder.chmod(0o700)
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)


def test_a_cache_that_cannot_be_made_costs_nothing_but_itself(bundle_dir, tmp_path):
    (tmp_path / "file").write_text("no folder")
    assert isinstance(read_bundle(bundle_dir, cache=ModelCache(tmp_path / "file")).model, bytes)
    assert isinstance(
        read_bundle(bundle_dir, cache=ModelCache(tmp_path / "file" / "below")).model, bytes
    )


def test_a_full_disk_costs_the_entry_alone(bundle_dir, clip_dir, tmp_path):
    """Limits files to 64 KiB, so that onnxruntime cannot write the weights."""
    program = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536));"
        "from cvo_edge.__main__ import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "run", str(bundle_dir), str(clip_dir), "--max-frames=2"],
        env={**os.environ, "CVO_EDGE_CACHE": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout.count('"status":"ok"')) == (0, 2), done.stderr
    assert list((tmp_path / "cache").iterdir()) == []


def test_processes_that_build_at_once_leave_one_whole_entry(bundle_dir, clip_dir, tmp_path, bundle):
    folder = tmp_path / "cache"
    command = [*CVO_EDGE, "run", str(bundle_dir), str(clip_dir)]
    running = [
        subprocess.Popen(
            [*command, "--max-frames=1", "--quiet"],
            env={**os.environ, "CVO_EDGE_CACHE": str(folder)},
            stdout=subprocess.PIPE,
        )
        for _ in range(4)
    ]
    outputs = [process.communicate()[0].splitlines() for process in running]
    poses = {json.loads(record)["pose"]["t_m"][0] for _, record in outputs}
    assert [process.returncode for process in running] == [0] * 4
    assert len(poses) == 1
    assert len(list(folder.iterdir())) == 1
    assert ModelCache(folder).find(bundle.calibration.model.sha256) is not None


def test_what_an_interrupted_build_left_is_swept_when_it_is_old(bundle_dir, cache):
    cache.folder.mkdir(mode=0o700)
    old, young = (cache.new_folder() for _ in range(2))
    assert old is not None
    assert young is not None
    os.utime(old, (0, 0))
    read_bundle(bundle_dir, cache=cache)
    assert not old.exists()
    assert young.exists()


def test_clear_removes_what_is_the_caches_own(bundle_dir, cache):
    read_bundle(bundle_dir, cache=cache)
    cache.new_folder()
    (cache.folder / "someone's").mkdir()
    (cache.folder / "note.txt").write_text("mine")
    # Folders of other programs: one contains a file of the same name, one also has a matching name.
    for name in ("data", 32 * "a"):
        (cache.folder / name).mkdir()
        (cache.folder / name / ENTRY_FILE).write_text("{}")
        (cache.folder / name / "thesis.txt").write_text("mine")
    assert [entry.current for entry in cache.entries()] == [True]
    assert cache.clear() == 1
    left = sorted(path.name for path in cache.folder.iterdir())
    assert left == [32 * "a", "data", "note.txt", "someone's"]


def test_a_damaged_entry_can_be_cleared(bundle_dir, cache):
    read_bundle(bundle_dir, cache=cache)
    (entry_folder(cache) / ENTRY_FILE).write_text("{")
    assert cache.entries() == []
    assert cache.clear() == 1
    assert list(cache.folder.iterdir()) == []


def test_an_entry_that_cannot_be_read_now_is_kept(bundle_dir, bundle, cache, monkeypatch):
    read_bundle(bundle_dir, cache=cache)
    with monkeypatch.context() as patch:
        patch.setattr("cvo_edge.engine.model_cache.file_digests", too_many_open_files)
        assert isinstance(read_bundle(bundle_dir, cache=cache).model, bytes)
    assert cache.find(bundle.calibration.model.sha256) is not None


def too_many_open_files(path):
    raise OSError(24, "Too many open files")


def test_an_entry_that_vanishes_while_it_is_loaded_is_done_without(bundle_dir, cache, monkeypatch):
    def read_and_clear(folder, *, cache, check):
        found = read_bundle(folder, cache=cache, check=check)
        if cache is not None:
            cache.clear()
        return found

    read_bundle(bundle_dir, cache=cache)
    monkeypatch.setattr("cvo_edge.odometer.read_bundle", read_and_clear)
    with Odometer.load(bundle_dir, cache=cache) as odometer:
        assert check_selftest(odometer) < odometer.calibration.selftest.tolerance


def test_a_user_without_a_home_has_no_cache(bundle_dir, monkeypatch):
    monkeypatch.delenv("CVO_EDGE_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", homeless)
    assert isinstance(read_bundle(bundle_dir, cache=ModelCache.default()).model, bytes)
    assert ModelCache.default().clear() == 0
    assert ModelCache.default().entries() == []


def homeless(path):
    raise RuntimeError("Could not determine home directory.")


def test_the_list_says_why_a_cache_is_not_used(bundle_dir, cache):
    read_bundle(bundle_dir, cache=cache)
    assert cache.obstacle() is None
    cache.folder.chmod(0o775)
    assert "writable only by its owner" in (cache.obstacle() or "")
    assert any(line.startswith("not used") for line in cache_lines(cache))


@pytest.mark.parametrize("file", ["", GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE])
def test_an_entry_that_others_may_write_to_is_made_anew(file, bundle_dir, bundle, cache):
    """Whoever can write to an entry can make its digests match."""
    read_bundle(bundle_dir, cache=cache)
    path = entry_folder(cache) / file
    path.chmod(0o777 if path.is_dir() else 0o664)
    assert cache.find(bundle.calibration.model.sha256) is None
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)
    assert path.stat().st_mode & 0o022 == 0


def test_a_permissive_umask_does_not_open_the_cache(bundle_dir, bundle, cache):
    before = os.umask(0o002)
    try:
        read_bundle(bundle_dir, cache=cache)
    finally:
        os.umask(before)
    assert cache.find(bundle.calibration.model.sha256) is not None


def test_files_of_root_and_of_this_user_are_trusted_and_others_are_not(monkeypatch):
    monkeypatch.setattr("cvo_edge.files.os.geteuid", lambda: 1000)

    def found(mode: int, user: int) -> os.stat_result:
        return os.stat_result((mode, 1, 1, 1, user, user, 0, 0, 0, 0))

    trusted = [(0o100644, 1000), (0o100444, 0), (0o40755, 0)]
    assert [untrusted(found(*each)) for each in trusted] == [False] * 3
    others = [(0o100644, 1001), (0o100664, 1000), (0o100646, 0), (0o40777, 1000)]
    assert [untrusted(found(*each)) for each in others] == [True] * 4


def test_a_folder_that_was_filled_before_may_be_read_only(bundle_dir, cache, monkeypatch):
    read_bundle(bundle_dir, cache=cache)

    def readable(path, mode):
        return mode & os.W_OK == 0

    monkeypatch.setattr("cvo_edge.engine.model_cache.os.access", readable)
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)
    other = bundle_dir.with_name("synthetic-room-csp")
    assert isinstance(read_bundle(other, cache=cache).model, bytes)
    assert len(list(cache.folder.iterdir())) == 1


def test_the_folder_is_named_by_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("CVO_EDGE_CACHE", str(tmp_path))
    assert ModelCache.default().folder == tmp_path
    monkeypatch.setenv("CVO_EDGE_CACHE", "relative")
    with pytest.raises(UsageError, match="absolute"):
        ModelCache.default()
    monkeypatch.delenv("CVO_EDGE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert ModelCache.default().folder == tmp_path / "cvo-edge"


@pytest.mark.parametrize("size", [0, 1, (1 << 20) - 1, 1 << 20, (1 << 20) + 1, 5 << 20])
def test_a_files_digests_depend_on_every_byte_and_the_length(size, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(size))
    found = {tuple(file_digests(path))}
    path.write_bytes(bytes(size + 1))
    found.add(tuple(file_digests(path)))
    places = {0, size // 2, size}
    for place in places:
        changed = bytearray(size + 1)
        changed[place] = 1
        path.write_bytes(changed)
        found.add(tuple(file_digests(path)))
    assert len(found) == 2 + len(places)


def test_a_files_digests_are_those_of_its_parts(tmp_path):
    content = np.random.default_rng(0).bytes((5 << 19) + 3)
    path = tmp_path / "file"
    path.write_bytes(content)
    parts = [content[start : start + (1 << 20)] for start in range(0, len(content), 1 << 20)]
    assert file_digests(path) == [hashlib.sha256(part).hexdigest() for part in parts]


def test_a_bundle_without_a_cache_is_read_as_before(bundle_dir):
    with Odometer.load(bundle_dir) as odometer:
        assert odometer.calibration == read_bundle(bundle_dir).calibration


@pytest.mark.parametrize("content", [b'{"name":"\xff"}', b"[" * 100_000, b"", b"{}", b"null"])
def test_an_entry_that_is_no_text_costs_its_advantage_only(content, bundle_dir, bundle, cache):
    read_bundle(bundle_dir, cache=cache)
    path = entry_folder(cache) / ENTRY_FILE
    path.write_bytes(content)
    assert cache.entries() == []
    assert cache.find(bundle.calibration.model.sha256) is None
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)
    (entry_folder(cache) / SEEN_FILE).write_bytes(content)
    assert isinstance(read_bundle(bundle_dir, cache=cache).model, CachedModel)


def test_a_model_that_has_grown_beyond_its_limit_is_refused_at_once(copied_bundle, cache):
    read_bundle(copied_bundle, cache=cache)
    with (copied_bundle / "model.onnx").open("r+b") as stream:
        stream.truncate(300 << 30)
    with pytest.raises(ModelError, match="at most 1073741824 bytes"):
        read_bundle(copied_bundle, cache=cache)
