"""Signatures: which bundles a device accepts or refuses, through both command lines."""

import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as changed

from cvo_edge import BundleMismatchError, GateError, Odometer, SinkError, UsageError
from cvo_edge.bundle.device_record import DeviceRecord
from cvo_edge.bundle.format import CALIBRATION_FILE, MODEL_FILE
from cvo_edge.bundle.signature import SIGNATURE_FILE
from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.model_cache import (
    ENTRY_FILE,
    WEIGHTS_FILE,
    CachedModel,
    ModelCache,
)
from cvo_edge.engine.own_files import file_digests
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.programs.verify import verify_bundle
from cvo_export.bundles.writing import check_target, write_bundle
from cvo_export.sign import PASSPHRASE, sign

pytest.importorskip("cryptography")
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    """The state file of a device that has not run any bundle."""
    monkeypatch.setenv("CVO_EDGE_STATE", str(tmp_path / "state"))
    return tmp_path / "state" / "versions.json"


def key_pair(folder, name, passphrase=None, private=None):
    """Write a new key pair and return its PEM files."""
    private = private or ed25519.Ed25519PrivateKey.generate()
    encryption = (
        serialization.BestAvailableEncryption(passphrase)
        if passphrase
        else serialization.NoEncryption()
    )
    secret, public = folder / f"{name}.pem", folder / f"{name}.pub.pem"
    secret.write_bytes(
        private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption
        )
    )
    public.write_bytes(
        private.public_key().public_bytes(
            serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
        )
    )
    return secret, public


@pytest.fixture
def keys(tmp_path):
    return key_pair(tmp_path, "ours")


def load(bundle, public):
    Odometer.load(bundle, threads=1, public_key=public).close()


def test_a_signed_bundle_is_taken_and_its_version_remembered(copied_bundle, keys, state):
    secret, public = keys
    signature = sign(copied_bundle, secret, 7)
    load(copied_bundle, public)
    assert json.loads(state.read_text()) == {signature.key: {signature.name: 7}}
    assert verify_bundle(copied_bundle, threads=1, public_key=public).name == signature.name
    # Without a public key, signatures are not checked.
    Odometer.load(copied_bundle, threads=1).close()


def test_an_unsigned_bundle_is_refused(bundle_dir, keys):
    with pytest.raises(BundleMismatchError, match=r"signature\.json: no such file"):
        load(bundle_dir, keys[1])
    with pytest.raises(BundleMismatchError, match=r"signature\.json: no such file"):
        verify_bundle(bundle_dir, threads=1, public_key=keys[1])


def test_a_signature_with_another_key_is_refused(copied_bundle, keys, tmp_path):
    foreign, _ = key_pair(tmp_path, "theirs")
    sign(copied_bundle, foreign)
    with pytest.raises(BundleMismatchError, match="expected a signature with the key"):
        load(copied_bundle, keys[1])
    # Stating the right key does not help either.
    path = copied_bundle / SIGNATURE_FILE
    ours = sign(copied_bundle, keys[0]).key
    sign(copied_bundle, foreign)
    path.write_text(json.dumps({**json.loads(path.read_text()), "key": ours}))
    with pytest.raises(BundleMismatchError, match="the signature is not valid for"):
        load(copied_bundle, keys[1])


def test_every_altered_key_of_a_signature_is_refused(copied_bundle, keys):
    secret, public = keys
    sign(copied_bundle, secret, 7)
    path = copied_bundle / SIGNATURE_FILE
    content = json.loads(path.read_text())
    for key, value in {
        "schema_version": 2,
        "name": "another",
        "version": 8,
        "calibration_sha256": "0" * 64,
        "key": "0" * 64,
        "signature": "0" * 128,
    }.items():
        for other in ({**content, key: value}, {k: v for k, v in content.items() if k != key}):
            path.write_text(json.dumps(other))
            with pytest.raises(BundleMismatchError, match=r"signature\.json"):
                load(copied_bundle, public)
    path.write_text(json.dumps({**content, "more": 1}))
    with pytest.raises(BundleMismatchError, match=r"signature\.json"):
        load(copied_bundle, public)
    path.write_text(json.dumps(content))
    load(copied_bundle, public)


def test_no_flipped_bit_of_a_signature_file_is_taken_for_another_claim(copied_bundle, keys):
    """Every changed file is refused, unless it parses to the same content."""
    secret, public = keys
    sign(copied_bundle, secret, 7)
    path = copied_bundle / SIGNATURE_FILE
    content = path.read_bytes()
    for place in range(0, len(content), 7):
        for bit in range(8):
            changed = bytearray(content)
            changed[place] ^= 1 << bit
            path.write_bytes(changed)
            try:
                load_only = json.loads(changed) == json.loads(content)
            except ValueError:
                load_only = False
            if not load_only:
                with pytest.raises(BundleMismatchError):
                    load(copied_bundle, public)


def test_another_bundle_s_files_are_refused(copied_bundle, artifacts_dir, keys):
    secret, public = keys
    sign(copied_bundle, secret, 7)
    other = artifacts_dir / "synthetic-room-cqr"
    shutil.copy(other / MODEL_FILE, copied_bundle)
    with pytest.raises(BundleMismatchError, match="expected sha256"):
        load(copied_bundle, public)
    shutil.copy(other / CALIBRATION_FILE, copied_bundle)
    with pytest.raises(BundleMismatchError, match="expected a signature for synthetic-room-cqr"):
        load(copied_bundle, public)


def test_an_older_version_is_refused_once_a_newer_one_has_run(copied_bundle, keys, state):
    secret, public = keys
    for version in (5, 9):
        sign(copied_bundle, secret, version)
        load(copied_bundle, public)
    sign(copied_bundle, secret, 8)
    for refused in (load, lambda b, k: verify_bundle(b, threads=1, public_key=k)):
        with pytest.raises(BundleMismatchError, match=r"expected version 9 .* found 8"):
            refused(copied_bundle, public)
    sign(copied_bundle, secret, 9)
    load(copied_bundle, public)
    # Verifying a newer bundle does not count as running it.
    sign(copied_bundle, secret, 10)
    verify_bundle(copied_bundle, threads=1, public_key=public)
    sign(copied_bundle, secret, 9)
    load(copied_bundle, public)
    assert list(json.loads(state.read_text()).values()) == [{"synthetic-room-cjp": 9}]


def test_a_record_of_versions_that_cannot_be_read_or_written_stops_it(copied_bundle, keys, state):
    secret, public = keys
    sign(copied_bundle, secret, 5)
    state.parent.mkdir()
    state.write_text("{")
    with pytest.raises(BundleMismatchError, match=r"versions\.json: the record of what"):
        load(copied_bundle, public)
    for content in (b'{"\xff": {"a": 1}}', b"[" * 100_000, b'{"a": 1}', b""):
        state.write_bytes(content)
        with pytest.raises(BundleMismatchError, match=r"versions\.json: the record of what"):
            load(copied_bundle, public)
    state.unlink()
    state.mkdir()
    with pytest.raises((BundleMismatchError, SinkError), match=r"versions\.json"):
        load(copied_bundle, public)


def test_processes_at_once_keep_the_highest(tmp_path):
    folder = tmp_path / "deep" / "state"
    code = (
        "import sys; from pathlib import Path\n"
        "from cvo_edge.bundle.device_record import DeviceRecord\n"
        "versions = DeviceRecord(Path(sys.argv[1]))\n"
        "for v in range(1, 100):\n"
        "    versions.raise_to('k', sys.argv[2], v); versions.raise_to('k', 'of all', v)"
    )
    names = ["a", "b", "c", "d"]
    processes = [subprocess.Popen([sys.executable, "-c", code, folder, name]) for name in names]
    assert [process.wait() for process in processes] == [0] * 4
    # Without a lock, a process would overwrite entries written after it had read the file.
    assert [DeviceRecord(folder).highest("k", name) for name in (*names, "of all")] == [99] * 5
    assert [p.name for p in folder.iterdir() if p.suffix not in (".json", ".lock")] == []


def test_a_lock_is_private_and_waited_for_within_a_limit(tmp_path):
    """Whoever can open the file can hold the lock for ever."""
    record = DeviceRecord(tmp_path / "state", patience_s=0.0)
    record.raise_to("k", "a", 1)
    lock = record.folder / "versions.lock"
    assert [path.stat().st_mode & 0o077 for path in (record.folder, lock)] == [0, 0]
    # A lock of an earlier release, which others may hold.
    lock.chmod(0o644)
    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(SinkError, match=r"versions\.lock: another process has held this lock"):
            record.raise_to("k", "a", 2)
    record.raise_to("k", "a", 2)
    assert record.highest("k", "a") == 2
    assert lock.stat().st_mode & 0o077 == 0


def test_a_record_that_others_can_write_to_proves_nothing(copied_bundle, keys, state):
    secret, public = keys
    sign(copied_bundle, secret, 7)
    load(copied_bundle, public)
    for path, mode in ((state, 0o664), (state.parent, 0o777)):
        before = path.stat().st_mode
        path.chmod(mode)
        with pytest.raises(BundleMismatchError, match=rf"{path.name}: expected files that only"):
            load(copied_bundle, public)
        path.chmod(before)
    load(copied_bundle, public)


def test_a_record_is_private_whatever_the_umask_and_may_lie_behind_a_link(
    copied_bundle, keys, tmp_path, monkeypatch
):
    secret, public = keys
    sign(copied_bundle, secret, 7)
    (tmp_path / "disk").mkdir(mode=0o755)
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    monkeypatch.setenv("CVO_EDGE_STATE", str(tmp_path / "link"))
    before = os.umask(0o002)
    try:
        load(copied_bundle, public)
    finally:
        os.umask(before)
    load(copied_bundle, public)
    assert (tmp_path / "disk" / "versions.json").is_file()


def test_another_signed_bundle_in_the_same_folder_must_be_named(
    copied_bundle, artifacts_dir, keys, state
):
    secret, public = keys
    sign(copied_bundle, secret, 7)
    with pytest.raises(BundleMismatchError, match="expected the bundle kitchen, found synthetic-"):
        Odometer.load(copied_bundle, public_key=public, name="kitchen")
    load(copied_bundle, public)
    other = artifacts_dir / "synthetic-room-cqr"
    for file in (MODEL_FILE, CALIBRATION_FILE):
        shutil.copy(other / file, copied_bundle)
    sign(copied_bundle, secret, 7)
    for refused in (load, lambda b, k: verify_bundle(b, threads=1, public_key=k)):
        with pytest.raises(BundleMismatchError, match="expected synthetic-room-cjp, which this"):
            refused(copied_bundle, public)
    verify_bundle(copied_bundle, threads=1, public_key=public, name="synthetic-room-cqr")
    Odometer.load(copied_bundle, threads=1, public_key=public, name="synthetic-room-cqr").close()
    load(copied_bundle, public)
    with pytest.raises(UsageError, match="name: expected a public key with it"):
        Odometer.load(copied_bundle, name="synthetic-room-cqr")


def test_a_version_that_fails_its_self_test_does_not_replace_the_one_before(
    copied_bundle, rewrite, bundle, keys, state
):
    secret, public = keys
    sign(copied_bundle, secret, 5)
    load(copied_bundle, public)
    remembered = state.read_text()
    test = bundle.calibration.selftest
    outputs = {name: tuple(v + 0.5 for v in values) for name, values in test.outputs.items()}
    rewrite(changed(bundle.calibration, selftest=changed(test, outputs=outputs)))
    sign(copied_bundle, secret, 9)
    with pytest.raises(GateError, match="self-test: expected outputs within"):
        load(copied_bundle, public)
    assert state.read_text() == remembered
    rewrite(bundle.calibration)
    sign(copied_bundle, secret, 6)
    load(copied_bundle, public)


def test_with_a_key_only_what_this_device_made_of_signed_bytes_is_taken_from_the_cache(
    copied_bundle, keys, tmp_path, state
):
    """Digests in the cache can be made to match other weights; those in the record cannot."""
    secret, public = keys
    sign(copied_bundle, secret, 5)
    cache = ModelCache(tmp_path / "cache")
    sealed = cache.sealed(DeviceRecord(state.parent), "key")
    digest = read_bundle(copied_bundle, cache=cache).calibration.model.sha256
    assert sealed.find(digest) is None
    assert isinstance(read_bundle(copied_bundle, cache=sealed).model, CachedModel)
    assert sealed.find(digest) is not None
    assert cache.sealed(DeviceRecord(state.parent), "another").find(digest) is None
    (folder,) = cache.folder.iterdir()
    weights, entry = folder / WEIGHTS_FILE, folder / ENTRY_FILE
    (np.fromfile(weights, np.float32) * 1.03).tofile(weights)
    stated = {**json.loads(entry.read_bytes()), "weights_sha256": file_digests(weights)}
    entry.write_text(json.dumps(stated))
    assert cache.find(digest) is not None
    assert sealed.find(digest) is None
    # It is made anew.
    with Odometer.load(copied_bundle, threads=1, cache=cache, public_key=public) as odometer:
        check_selftest(odometer)


def test_a_signed_bundle_can_be_replaced_and_loses_its_signature(copied_bundle, bundle, keys):
    sign(copied_bundle, keys[0])
    check_target(copied_bundle)
    write_bundle(copied_bundle, bundle.calibration, bundle.model_bytes)
    assert not (copied_bundle / SIGNATURE_FILE).exists()
    (copied_bundle / "notes.txt").write_text("mine")
    with pytest.raises(SinkError, match="found other files"):
        check_target(copied_bundle)


@pytest.mark.parametrize("kind", ["none", "text", "private", "another curve"])
def test_anything_but_an_ed25519_public_key_is_refused(copied_bundle, keys, tmp_path, kind):
    path = tmp_path / "key.pem"
    if kind == "text":
        path.write_text("no key")
    elif kind == "private":
        path = keys[0]
    elif kind == "another curve":
        private = ec.generate_private_key(ec.SECP256R1())
        _, path = key_pair(tmp_path, "curve", private=private)
    with pytest.raises(UsageError, match=str(path.name)):
        load(copied_bundle, path)


def test_a_private_key_may_be_encrypted(copied_bundle, tmp_path, monkeypatch):
    secret, public = key_pair(tmp_path, "ours", b"open sesame")
    with pytest.raises(UsageError, match=f"the key is encrypted; set {PASSPHRASE}"):
        sign(copied_bundle, secret)
    monkeypatch.setenv(PASSPHRASE, "wrong")
    with pytest.raises(UsageError, match="passphrase"):
        sign(copied_bundle, secret)
    monkeypatch.setenv(PASSPHRASE, "open sesame")
    sign(copied_bundle, secret)
    load(copied_bundle, public)


def test_both_command_lines(copied_bundle, clip_dir, keys, tmp_path):
    secret, public = keys

    def program(name, *arguments):
        module = {"cvo-edge": "cvo_edge.__main__", "cvo-export": "cvo_export.cli"}[name]
        code = f"from {module} import main; main()"
        return subprocess.run(
            [sys.executable, "-c", code, *map(str, arguments)],
            capture_output=True,
            text=True,
            check=False,
        )

    run = ("run", copied_bundle, clip_dir, "--max-frames", 2, "--quiet", "--public-key", public)
    unsigned = program("cvo-edge", *run)
    assert (unsigned.returncode, unsigned.stdout) == (5, "")
    signed = program("cvo-export", "sign", copied_bundle, "--key", secret, "--bundle-version", 3)
    assert signed.returncode == 0
    assert "version 3, signed with the key" in signed.stdout
    assert len(program("cvo-edge", *run).stdout.splitlines()) == 1 + 2
    checked = program("cvo-edge", "verify", copied_bundle, "--public-key", public)
    assert (checked.returncode, checked.stderr) == (0, "")
    program("cvo-export", "sign", copied_bundle, "--key", secret, "--bundle-version", 2)
    for command in (run, ("verify", copied_bundle, "--public-key", public)):
        older = program("cvo-edge", *command)
        assert older.returncode == 5
        assert len(older.stderr.splitlines()) == 1


def test_openssl_makes_keys_that_fit(copied_bundle, tmp_path):
    if shutil.which("openssl") is None:
        pytest.skip("no openssl here")
    secret, public = tmp_path / "key.pem", tmp_path / "key.pub.pem"
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", secret], check=True)
    subprocess.run(["openssl", "pkey", "-in", secret, "-pubout", "-out", public], check=True)
    sign(copied_bundle, Path(secret))
    load(copied_bundle, Path(public))


def test_what_lies_where_a_signature_is_written_is_not_followed(copied_bundle, keys, tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (copied_bundle / SIGNATURE_FILE).symlink_to(victim)
    (copied_bundle / f"{SIGNATURE_FILE}.00000000.partial").symlink_to(victim)
    # Fix the random part of the temporary file's name, so that the link is in its place.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cvo_edge.files.os.urandom", bytes)
        with pytest.raises(SinkError):
            sign(copied_bundle, keys[0])
    sign(copied_bundle, keys[0])
    assert victim.read_text() == "precious"
    assert not (copied_bundle / SIGNATURE_FILE).is_symlink()
    load(copied_bundle, keys[1])


def test_keys_may_lie_behind_links(copied_bundle, keys, tmp_path):
    links = [tmp_path / f"link-{number}" for number in range(2)]
    for link, key in zip(links, keys, strict=True):
        link.symlink_to(key)
    sign(copied_bundle, links[0])
    load(copied_bundle, links[1])


def test_a_device_remembers_in_one_place_or_says_that_it_cannot(copied_bundle, keys, monkeypatch):
    sign(copied_bundle, keys[0])
    monkeypatch.setenv("CVO_EDGE_STATE", "relative")
    with pytest.raises(UsageError, match="CVO_EDGE_STATE: expected an absolute path"):
        load(copied_bundle, keys[1])
    monkeypatch.delenv("CVO_EDGE_STATE")
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)

    def homeless(path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", homeless)
    with pytest.raises((BundleMismatchError, SinkError), match=r"(versions|names)\.json"):
        load(copied_bundle, keys[1])
