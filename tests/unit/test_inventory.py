"""Phone inventories: which tables of a language are valid."""

import sys
from pathlib import Path

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import find_language, load_inventory
from tests.languages import MANDARIN, installed_language, small_inventory

TOO_MANY_PHONES = tuple(chr(97 + n // 26) + chr(97 + n % 26) for n in range(256))


def test_mandarin_has_the_phones_of_the_paper() -> None:
    """Li et al. 2011, section 3.1: 21 initials, 38 finals and silence."""
    assert (len(MANDARIN.initials), len(MANDARIN.vowels), MANDARIN.silence) == (21, 38, "sil")
    assert len(MANDARIN) == 60
    assert MANDARIN.pronounce("你好") == [("n", "i"), ("h", "ao")]
    assert MANDARIN.pronounce("ni3 hǎo") == [("n", "i"), ("h", "ao")]
    with pytest.raises(UserError, match="'abc'"):
        MANDARIN.pronounce("你abc，x")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"phones": ("m", "m", "sil")}, "phones must be distinct"),
        ({"phones": ("m", "A", "sil")}, "1 to 4 letters a-z"),
        ({"phones": TOO_MANY_PHONES}, "more than 255 phones"),
        ({"kinds": ("initial", "vowel", "vowel")}, "exactly one phone must be silence"),
        ({"kinds": ("initial", "silence", "vowel")}, "exactly one phone must be silence: sil"),
        ({"kinds": ("initial", "final", "silence")}, "one of initial, vowel, silence"),
        ({"visemes": {"m": (("b", 1.0),), "a": (("a", 0.9),)}}, "fractions of a must add up"),
    ],
)
def test_rejects_bad_phones(changes: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=f"language small: .*{message}"):
        small_inventory(**changes)


def test_rejects_an_unknown_language() -> None:
    error = "language 'klingon' is not installed; choose from: auto, zh, [a-z, ]*de, [a-z, ]*$"
    with pytest.raises(UserError, match=error) as raised:
        load_inventory("klingon")
    assert "dutch" not in str(raised.value)  # already listed as nl


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (None, r"phones\.tsv"),
        ("phone\tkind\tvisemes\nsil\tsilence\trest:1\n", "before_rounded"),
        ("phone\tkind\tvisemes\tbefore_rounded\nsil\tsilence\trest\t\n", "not enough values"),
        ("phone\tkind\tvisemes\tbefore_rounded\nsil\tsilence\trest:one\t\n", "one"),
        ("phone\tkind\tvisemes\tbefore_rounded\nsil\tsilence\trest:1\t\n", "pronounce"),
    ],
)
def test_rejects_a_broken_package(
    table: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "broken_language", raising=False)  # of an earlier case
    package = tmp_path / "broken_language"
    package.mkdir()
    (package / "__init__.py").touch()
    if table is not None:
        (package / "phones.tsv").write_text(table)
    error = f"language broken: cannot read package broken_language: .*{message}"
    with (
        installed_language(tmp_path, "broken", "broken_language"),
        pytest.raises(UserError, match=error),
    ):
        load_inventory("broken")


@pytest.mark.parametrize(
    ("settings", "phones", "message"),
    [
        ('code = "zxx"\ntitles = {}\nvoice = "cs"\nscripts = []\n', "p\na\nsil\n", ""),
        ('code = "zxx"\n', "p\nsil\n", r"language\.toml lacks titles, voice, scripts"),
        ('code = "zxx"\ntitles = {}\nvoice = "cs"\nscripts = []\n', "tʃ\nsil\n", "tʃ: use the sym"),
    ],
    ids=["valid", "no titles", "IPA"],
)
def test_an_installed_language_of_tables_is_found_by_its_code(
    settings: str, phones: str, message: str, tmp_path: Path
) -> None:
    name = f"tables_{len(phones)}_{len(settings)}"  # not cached by another case
    package = tmp_path / name
    package.mkdir()
    (package / "language.toml").write_text(settings, "utf-8")
    (package / "phones.tsv").write_text(f"phone\n{phones}", "utf-8")
    with installed_language(tmp_path, name, name):
        if message:
            with pytest.raises(UserError, match=message):
                find_language(name)
            with pytest.raises(UserError, match="'zxx' is not installed"):
                find_language("zxx")
        else:
            assert find_language("zxx") == find_language(name) == name
