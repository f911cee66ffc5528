"""Turns msgspec's errors about fields into sentences for users."""

import re

from kouxing_client.field_types import SESSION_NAME

from kouxing.shared.name_rules import NAME, NAME_RULE

_TYPES = {
    "array": "a list",
    "bool": "true or false",
    "bytes": "binary data",
    "float": "a number",
    "int": "an integer",
    "null": "null",
    "object": "an object",
    "str": "a string",
}
_ITEMS = {"bytes": "bytes", "str": "characters"}
_ERROR = re.compile(r"Expected `(?P<types>[^`]+)`(?P<rest>.*) - at `\$\.(?P<name>.+)`", re.DOTALL)
_LIMITS = {"<=": "of at most", ">=": "of at least", "<": "below", ">": "above"}


def describe_field_error(error: Exception) -> str:
    """Return a sentence that names the field and its rule.

    Errors that name no field keep their text.

    >>> import msgspec
    >>> describe_field_error(msgspec.ValidationError("Expected `int` <= 9 - at `$.number`"))
    'number must be an integer of at most 9'
    """
    match = _ERROR.fullmatch(str(error))
    if match is None:
        problem, _, name = str(error).partition(" - at `$.")
        return f"{name.rstrip('`')}: {problem}" if name else problem
    types = _list_types(match["types"])
    rest, name = match["rest"], match["name"]
    if rest.startswith(", got `"):
        return f"{name} must be {types}, not {_list_types(rest[7:].rstrip('`'))}"
    if pattern := re.fullmatch(r" matching regex ['\"]\^(.*)\$.*['\"]", rest):
        if pattern[1] in (NAME, SESSION_NAME):
            return f"{name} is not a valid name; {NAME_RULE}"
        return f"{name} must be {pattern[1].strip('()').replace('|', ' or ')}"
    if rest.startswith(" of length"):
        rest = f"{rest.removeprefix(' of length')} {_ITEMS.get(match['types'], 'items')}"
    limit, _, value = rest.strip().partition(" ")
    return f"{name} must be {types} {_LIMITS.get(limit, limit)} {value}".rstrip()


def _list_types(types: str) -> str:
    names = types.removesuffix(" | null").split(" | ")
    return " or ".join(_TYPES.get(name, name) for name in names)
