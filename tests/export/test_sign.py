"""Signatures: which bundles a device accepts or refuses, through both command lines."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cvo_edge import BundleMismatchError, Odometer, SinkError, UsageError
from cvo_edge.bundle.format import CALIBRATION_FILE, MODEL_FILE
from cvo_edge.bundle.signature import SIGNATURE_FILE, Versions
from cvo_edge.programs.verify import verify_bundle
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
        for changed in ({**content, key: value}, {k: v for k, v in content.items() if k != key}):
            path.write_text(json.dumps(changed))
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
    with pytest.raises(BundleMismatchError, match=r"versions\.json: the record of versions"):
        load(copied_bundle, public)
    for content in (b'{"\xff": {"a": 1}}', b"[" * 100_000, b'{"a": 1}', b""):
        state.write_bytes(content)
        with pytest.raises(BundleMismatchError, match=r"versions\.json: the record of versions"):
            load(copied_bundle, public)
    state.unlink()
    state.mkdir()
    with pytest.raises((BundleMismatchError, SinkError), match=r"versions\.json"):
        load(copied_bundle, public)


def test_processes_at_once_keep_the_highest(tmp_path):
    path = tmp_path / "deep" / "versions.json"
    code = (
        "import sys; from pathlib import Path; from cvo_edge.bundle.signature import Versions\n"
        "versions = Versions(Path(sys.argv[1]))\n"
        "for v in range(1, 100):\n"
        "    versions.raise_to('k', sys.argv[2], v); versions.raise_to('k', 'of all', v)"
    )
    names = ["a", "b", "c", "d"]
    processes = [subprocess.Popen([sys.executable, "-c", code, path, name]) for name in names]
    assert [process.wait() for process in processes] == [0] * 4
    # Without a lock, a process would overwrite entries written after it had read the file.
    assert [Versions(path).highest("k", name) for name in (*names, "of all")] == [99] * 5
    assert [p.name for p in path.parent.iterdir() if p.suffix not in (".json", ".lock")] == []


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
    with pytest.raises((BundleMismatchError, SinkError), match=r"versions\.json"):
        load(copied_bundle, keys[1])
