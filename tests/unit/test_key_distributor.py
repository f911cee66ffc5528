"""Workers receive the list of allowed keys, and receive it again after each change."""

import pytest

from kouxing.services.control.key_distributor import KeyDistributor
from kouxing.shared.fast_record import replace
from kouxing.shared.network.zap import Zap
from kouxing.shared.settings.keys import load_key, revoke_key
from kouxing.shared.wire.control import AllowedKey
from tests.control_cluster import worker

WORKER = worker("recognizer", "recognizer-1")


@pytest.mark.usefixtures("new_keys")
def test_a_worker_receives_each_version_of_the_list_once() -> None:
    lamp = load_key("lamp", ("client",))
    zap = Zap(lambda _changed: None)
    keys = KeyDistributor(zap)
    allowed = {lamp.public: AllowedKey(name="lamp", roles=["client"])}
    assert keys.next_key_update(replace(WORKER, role="observer")) is None
    assert keys.next_key_update(WORKER) == allowed
    assert keys.next_key_update(WORKER) is None
    keys.forget(WORKER.instance)
    assert keys.next_key_update(WORKER) == allowed
    revoke_key("lamp")
    zap.refresh()
    assert keys.next_key_update(WORKER) == {}


def test_without_encryption_there_is_no_list() -> None:
    assert KeyDistributor(None).next_key_update(WORKER) is None
