"""A made-up language of seven phones and silence, spelled as it is spoken: a letter is a phone.

The tests install it as a distribution would be (see ``tests.languages.install_language``).
"""

import re

from kouxing.shared.errors import UserError


def pronounce(text: str) -> list[tuple[str, ...]]:
    """Return the phones of each syllable: an ``m``, if there is one, and a vowel."""
    words = text.lower().split()
    wrong = [word for word in words if not re.fullmatch("(m?[aoeiuy])+", word)]
    if wrong:
        raise UserError(f"cannot read {wrong[0]!r}; write a o e i u y, each with an m or without")
    return [tuple(syllable) for word in words for syllable in re.findall("m?[aoeiuy]", word)]
