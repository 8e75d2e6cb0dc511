"""The plugin that counts instructions knows their kinds by their encodings."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess

import pytest

from boards.instructions import KINDS
from boards.machine import ROOT

# As an assembler encodes them.
ENCODINGS = {
    "float products": {
        "fmla v0.4s, v1.4s, v2.4s": 0x4E22CC20,
        "fmla v0.4s, v1.4s, v2.s[0]": 0x4F821020,
        "fmul v0.4s, v1.4s, v2.4s": 0x6E22DC20,
    },
    "8-bit dot products": {
        "sdot v0.4s, v1.16b, v2.16b": 0x4E829420,
        "udot v0.4s, v1.16b, v2.16b": 0x6E829420,
        "sdot v0.4s, v1.16b, v2.4b[0]": 0x4F82E020,
    },
    "integer products": {
        "smlal v0.4s, v1.4h, v2.4h": 0x0E628020,
        "umull v0.8h, v1.8b, v2.8b": 0x2E22C020,
        "mul v0.4s, v1.4s, v2.4s": 0x4EA29C20,
    },
    "other vector": {
        "sadalp v0.8h, v1.16b": 0x4E206820,
        "add v0.4s, v1.4s, v2.4s": 0x4EA28420,
        "movi v0.4s, #0": 0x4F000400,
        "scvtf v0.4s, v1.4s": 0x4E21D820,
        "fmadd s0, s1, s2, s2": 0x1F020820,
    },
    "vector memory": {"ldr q0, [x0]": 0x3DC00000, "ld1 {v0.16b}, [x0]": 0x4C407000},
    "other memory": {"ldr x0, [x1]": 0xF9400020, "stp x0, x1, [sp]": 0xA90007E0},
    "other": {"add x0, x0, x1": 0x8B010000, "b .": 0x14000000, "cmp x0, #0": 0xF100001F},
}


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_each_instruction_is_counted_as_its_kind(tmp_path):
    plugin = tmp_path / "instructions.so"
    source = ROOT / "boards" / "instructions.c"
    command = ["cc", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-o", plugin, source]
    subprocess.run(command, check=True)
    # qemu has the functions that it calls; none is called here.
    kind_of = ctypes.CDLL(str(plugin), os.RTLD_LAZY).kind_of
    found = {
        kind: {text: KINDS[kind_of(word)] for text, word in words.items()}
        for kind, words in ENCODINGS.items()
    }
    assert found == {kind: dict.fromkeys(words, kind) for kind, words in ENCODINGS.items()}
