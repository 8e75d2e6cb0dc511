"""Files are written completely or not at all; failures yield a one-line error."""

import os
from pathlib import Path

import pytest

from cvo_edge.errors import SinkError
from cvo_edge.files import read_regular_file, whole_file, write_text, write_whole


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_is_replaced_whole(tmp_path, durable):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with whole_file(path, durable=durable) as stream:
        stream.write(b"new")
        stream.flush()
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("content", [b"x" * 2000, "x" * 2000])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, files_limited, content):
    path = tmp_path / "a.txt"
    path.write_text("old")
    full = pytest.raises(SinkError, match=r"a.txt: cannot be written: File too large")
    with files_limited(1000), full:
        write_whole(path, content)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_library_that_hides_the_failed_write_is_a_sink_error_too(tmp_path):
    def saves() -> None:
        try:
            raise OSError(28, "No space left on device")
        except OSError:
            raise RuntimeError("unexpected position")  # noqa: B904 - like torch.save

    with pytest.raises(SinkError, match="No space left"), whole_file(tmp_path / "a"):
        saves()


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_other_errors_pass_and_leave_nothing(tmp_path, error):
    def fails(path) -> None:
        with whole_file(path) as stream:
            stream.write(b"half")
            raise error

    with pytest.raises(error):
        fails(tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_what_is_no_regular_file_is_refused_by_its_kind(tmp_path):
    content = tmp_path / "content"
    content.write_bytes(b"content")
    link = tmp_path / "link"
    link.symlink_to(content)
    os.mkfifo(tmp_path / "pipe")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for path, kind in (
        (tmp_path, "a folder"),
        (link, "a symbolic link; copy with cp -L"),
        (tmp_path / "pipe", "another kind of file"),
    ):
        with pytest.raises(SinkError, match=f"expected a regular file, found {kind}$"):
            read_regular_file(path, 100, SinkError)
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    assert read_regular_file(link, 100, SinkError, links=True) == b"content"


def test_a_folder_is_made_only_on_request(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with pytest.raises(SinkError, match="No such file"):
        write_whole(path, "text")
    write_whole(path, "text", make_folder=True)
    assert path.read_text() == "text"


def test_a_link_is_replaced_and_what_it_names_is_kept(tmp_path):
    (tmp_path / "kept").write_text("kept")
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    write_whole(tmp_path / "link", "new")
    assert not (tmp_path / "link").is_symlink()
    assert (tmp_path / "kept").read_text() == "kept"


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").touch()
    write_whole(tmp_path / "a", "text")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_text_goes_through_links_and_into_devices(tmp_path, capsys):
    (tmp_path / "kept").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    write_text(str(tmp_path / "link"), "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "kept").read_text() == "new"
    write_text(os.devnull, "text")
    assert not Path(os.devnull).is_file()
    write_text("-", "to standard output")
    assert capsys.readouterr().out == "to standard output"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_text_to_a_full_device_is_a_sink_error():
    with pytest.raises(SinkError, match="/dev/full: cannot be written: No space left"):
        write_text("/dev/full", "text")
