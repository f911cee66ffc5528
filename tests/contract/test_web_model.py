"""The models for the browser get their constants from other modules, by name."""

import pytest

from kouxing.services.cli.web_model import _CONSTANTS


@pytest.mark.parametrize("name", _CONSTANTS)
def test_modules_have_the_constants_that_the_browser_needs(name: str) -> None:
    module, constants = _CONSTANTS[name]
    missing = set(constants.split()) - vars(module).keys()
    assert not missing, f"{module.__name__}: rename {missing} in cli/web_model.py and kouxing-lips"
