"""Texts of strangers, shown on terminals and pages: no character controls them or is invisible."""

import sys
import unicodedata

import pytest

from hgn.card import _plain
from hgn.config import NetworkConfig
from hgn.scene.scene_file import load_scene
from hgn.scene.scene_notes import notes_on_files
from hgn.schema import ConfigError, from_mapping, printable

# control and format characters, and separators of lines, paragraphs and words
KINDS = ("Cc", "Cf", "Zl", "Zp", "Zs")
BIDI = "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"


@pytest.fixture(scope="module")
def unseen():
    """Characters of these kinds, and others without a picture."""
    characters = [chr(code) for code in range(sys.maxunicode + 1) if unicodedata.category(chr(code)) in KINDS]
    return [*(character for character in characters if character not in " \n"), "\ud800", "\ue000", "\U0010ffff"]


def test_no_unseen_character_is_shown(unseen):
    """Each is shown by its number, also between others and after letters."""
    for before, after in (("", ""), ("a", "b"), ("\x1b", "\u202e")):
        for character in unseen:
            shown = printable(before + character + after)
            assert shown.isprintable() and shown != before + after, ascii(character)


def test_cards_show_no_unseen_character(unseen):
    """Nor as a number that a browser turns into the character."""
    for character in unseen:
        shown = _plain(f"a{character}b")
        assert shown.isprintable() and f"&#{ord(character)};" not in shown, ascii(character)


@pytest.mark.parametrize("character", [*BIDI, "\u2028", "\u2029"])
def test_settings_have_no_bidirectional_controls(character):
    """A name that reads backwards, or fills two lines, could show something else than it is."""
    with pytest.raises(ConfigError, match="kind must be text without control characters"):
        from_mapping(NetworkConfig, {"kind": f"hgn{character}"})


def test_notes_on_files_show_no_unseen_character(tmp_path):
    """Names of meshes may have invisible characters, which languages use."""
    name = "a\u200b\ufeff\u3000b.obj"
    (tmp_path / name).write_text("v 0.4 0 0.4\nv 0.6 0 0.4\nv 0.4 0 0.6\nf 1 2 3\n")
    group = "{shape: cube, material: water, size: 0.1, position: [0.5, 0.7, 0.5]}"
    text = f"groups: [{group}]\nobstacles: [{{mesh: '{name}'}}]\n"
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    (note, *_) = notes_on_files(load_scene(tmp_path / "scene.yaml"))
    assert note.isprintable() and r"a\u200b\ufeff\u3000b.obj" in note
