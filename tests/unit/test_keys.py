"""Keys in files: made once, private, allowed and revoked."""

import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from kouxing_client import KouxingError
from kouxing_client.keys import read_key

from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.settings.keys import (
    MAX_KEYS,
    MAX_ROLES,
    Grant,
    add_key,
    check_keys,
    key_folder,
    load_key,
    load_user_key,
    may_subscribe,
    read_grants,
    rejection_hint,
    revoke_key,
    save_grants,
)
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import AllowedKey
from kouxing.shared.wire.message import MAX_MESSAGE_BYTES
from tests.samples import SAMPLES

pytestmark = pytest.mark.usefixtures("new_keys")


def test_creates_private_keys_on_first_use() -> None:
    key = load_key("lamp", ("service:lamp",))
    assert load_key("lamp", ("service:lamp",)) == key
    assert key.control == load_key("control", ()).public != key.public
    assert read_grants() == {key.public: Grant("lamp", ("service:lamp",))}
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in key_folder().iterdir()}
    assert modes == dict.fromkeys(("control.key", "lamp.key", "allowed"), 0o600)
    assert stat.S_IMODE(key_folder().stat().st_mode) == 0o700


def test_concurrent_processes_create_one_key() -> None:
    program = "from kouxing.shared.settings.keys import load_user_key; print(load_user_key())"
    started = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) for _ in range(4)
    ]
    assert len({process.communicate()[0] for process in started}) == 1
    assert [grant.name for grant in read_grants().values()] == ["client"]


@pytest.mark.parametrize("name", ["", "client.key", "allowed"])
def test_rejects_files_that_others_can_read_or_own(name: str) -> None:
    load_user_key()
    path = key_folder() / name
    path.chmod(0o750)
    with pytest.raises(UserError, match=f"other users can read {path}; run 'chmod [67]00 "):
        (load_user_key(), read_grants())
    path.chmod(0o700)
    os.chown(path, os.geteuid() + 1, -1)
    with pytest.raises(UserError, match=f"{path} belongs to another user"):
        (load_user_key(), read_grants())


def test_names_an_invalid_key_file_and_an_unusable_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_user_key()
    for text in ("", '{"public": 1, "secret": 2, "control": 3}', "é"):
        (key_folder() / "client.key").write_text(text, encoding="utf-8")
        with pytest.raises(UserError, match=r"client\.key"):
            load_user_key()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(UserError, match=r"file/kouxing: Not a directory\); set XDG_STATE_HOME"):
        load_user_key()


@pytest.mark.parametrize("text", ["~" * 40, "a" * 39, "a" * 40 + "\\n"])
def test_a_key_is_z85_in_every_program(text: str) -> None:
    load_user_key()
    path = key_folder() / "client.key"
    path.write_text(f'{{"public": "{text}", "secret": "{"b" * 40}", "control": "{"c" * 40}"}}')
    with pytest.raises(KouxingError, match="is not a valid key file"):
        read_key(path)
    with pytest.raises(UserError, match="is not a valid key file"):
        load_user_key()


def test_a_folder_and_a_pipe_are_not_keys_and_are_closed(tmp_path: Path) -> None:
    def next_descriptor() -> int:
        with tmp_path.joinpath("file").open("w") as file:
            return file.fileno()

    free = next_descriptor()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(KouxingError, match="is not a valid key file"):
        read_key(tmp_path / "pipe")
    with pytest.raises(KouxingError, match="Is a directory"):
        read_key(tmp_path)
    assert next_descriptor() == free


def test_adds_and_revokes_a_key(tmp_path: Path) -> None:
    roles = [f"subscriber:s{number}" for number in range(MAX_ROLES + 1)]
    for name, wrong, error in (
        ("a b", ["client"], "a b"),
        ("a", ["root"], "root"),
        ("a", ["service:"], "service:"),
        ("many", roles, "many has 17 roles, but the maximum is 16"),
    ):
        with pytest.raises(UserError, match=error):
            add_key(name, wrong, tmp_path / "wrong")
    with pytest.raises(UserError, match="cannot write"):
        add_key("laptop", ["client"], tmp_path / "nowhere" / "laptop.key")
    assert read_grants() == {}
    assert not (tmp_path / "wrong").exists()
    add_key("laptop", ["client"], tmp_path / "1")
    with pytest.raises(UserError, match="kouxing keys revoke laptop"):
        add_key("laptop", ["client"], tmp_path / "2")
    save_grants({})  # from control, before it read the new key
    assert len(read_grants()) == 1, "only commands change the list on control's machine"
    revoke_key("laptop")
    assert read_grants() == {}
    with pytest.raises(UserError, match="no key is named 'laptop'"):
        revoke_key("laptop")
    add_key("laptop", roles[1:], tmp_path / "2")


def test_an_added_key_works_on_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = tmp_path / "given.key"
    add_key("laptop", ("client",), given)
    (public,) = read_grants()
    control = load_key("control", ())
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    key_folder().mkdir(parents=True, mode=0o700)
    given.rename(key_folder() / "client.key")
    assert (load_user_key().public, load_user_key().control) == (public, control.public)
    with pytest.raises(UserError, match="kouxing keys add NAME --role service:lamp"):
        load_key("lamp", ("service:lamp",))
    save_grants({public: Grant("laptop", ("client",))})
    assert read_grants() == {public: Grant("laptop", ("client",))}


def test_creates_no_key_for_control_on_another_machine() -> None:
    with pytest.raises(UserError, match=r"lamp\.key is missing.*kouxing keys add NAME --role"):
        load_key("lamp", ("service:lamp",), control="tcp://192.0.2.1:5550")
    with pytest.raises(UserError, match=r"host name .no-such-host.* is unknown"):
        load_key("lamp", ("service:lamp",), control="tcp://no-such-host.invalid:5550")
    assert not list(key_folder().glob("*"))
    assert load_key("lamp", ("service:lamp",), control="tcp://127.0.0.1:5550")


def empty(path: Path) -> None:
    path.write_text("")


def use_other_secret(path: Path) -> None:
    own, other = load_key("lamp", ()).secret, load_key("client", ()).secret
    path.write_text(path.read_text().replace(own, other))


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("allowed", empty, r"allowed does not allow .*rm .*lamp"),
        ("lamp.key", use_other_secret, r"the secret key .*: kouxing keys revoke lamp; rm .*lamp"),
        ("lamp.key", empty, r"is not a valid key file.*revoke lamp; rm -r .*lamp"),
        ("control.key", lambda path: path.write_text("{"), r"control\.key .*rm -r .*kouxing"),
        ("control.key", Path.unlink, r"control\.key .*rm -r .*kouxing"),
        ("lamp.key", Path.unlink, r"another key has the name 'lamp'"),
        ("lamp.key", lambda path: path.chmod(0), r"no permission .*chmod 600 .*lamp"),
        ("allowed", lambda path: path.write_text("no key"), r"delete this line.*rm -r "),
    ],
)
def test_checks_the_keys_of_a_system(
    name: str, damage: Callable[[Path], object], message: str
) -> None:
    check_keys({"lamp": ("service:lamp",), "control": ()})
    damage(key_folder() / name)
    with pytest.raises(UserError, match=message):
        check_keys({"lamp": ("service:lamp",), "control": ()})


def test_a_new_key_of_control_replaces_all_others() -> None:
    check_keys({"control": (), "lamp": ("service:lamp",)})
    for path in key_folder().glob("*.key"):
        path.unlink()
    check_keys({"control": ()})
    assert [grant.name for grant in read_grants().values()] == ["client"]


def test_names_the_key_of_another_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_key("host", ["service:lamp"], tmp_path / "host.key")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    load_key("lamp", ("service:lamp",))  # started before its key was copied
    (tmp_path / "host.key").replace(key_folder() / "lamp.key")
    with pytest.raises(UserError, match=r"different system.*rm .*control\.key .*allowed"):
        load_key("lamp", ("service:lamp",), control="tcp://192.0.2.1:5550")


@pytest.mark.parametrize(
    ("control", "hint"),
    [("tcp://host:5550 key", "driver.key"), ("tcp://host:5550", "set only here")],
)
def test_the_rejection_hint_names_control_and_the_fix(control: str, hint: str) -> None:
    text = rejection_hint(control, "driver", ("service:driver",))
    assert "control at tcp://host:5550 " in text
    assert hint in text


def test_a_credential_takes_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key, grants = load_key("lamp", ("service:lamp",)), read_grants()
    secrets = tmp_path / "secrets"
    secrets.mkdir()
    for name in ("lamp.key", "allowed"):
        (key_folder() / name).rename(secrets / name)
        (secrets / name).chmod(0o440)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "empty"))
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", f"{secrets}/")
    assert load_key("lamp", ()) == key
    assert read_grants() == grants
    assert not key_folder().exists(), "nothing need be written"
    (secrets / "lamp.key").chmod(0o444)
    with pytest.raises(UserError, match="other users can read"):
        load_key("lamp", ())


@pytest.mark.parametrize(
    ("roles", "number"),
    [(["client"], MAX_KEYS - 1), ([f"subscriber:{n:064}" for n in range(MAX_ROLES)], 580)],
)
def test_rejects_too_many_keys_but_revokes_them(
    tmp_path: Path, roles: list[str], number: int
) -> None:
    add_key("first", ("client",), tmp_path / "first.key")
    allowed = key_folder() / "allowed"
    text = allowed.read_text(encoding="ascii")
    lines = [f"{n:040} name-{n:055} {' '.join(roles)}\n" for n in range(number + 20)]
    allowed.write_text(text + "".join(lines[:number]), encoding="ascii")
    grants = read_grants().items()
    keys = {
        public: AllowedKey(name=grant.name, roles=list(grant.roles)) for public, grant in grants
    }
    reply = replace(SAMPLES["heartbeat-reply"], keys=keys)
    assert sum(map(len, encode(reply))) < MAX_MESSAGE_BYTES
    allowed.write_text(text + "".join(lines), encoding="ascii")
    with pytest.raises(UserError, match=f"{allowed}: .*revoke some with 'kouxing keys revoke'"):
        read_grants()
    with pytest.raises(UserError, match="revoke some with 'kouxing keys revoke'"):
        add_key("last", roles, tmp_path / "last.key")
    revoke_key("first")


@pytest.mark.parametrize(
    ("roles", "topic", "may"),
    [
        (("client",), b"", True),
        (("subscriber:*",), b"fap-frame/", True),
        (("subscriber:a",), b"fap-frame/a/", True),
        (("subscriber:a", "subscriber:a"), b"fap-frame/b/", False),
        (("subscriber:a", "subscriber:b"), b"sound/b/", True),
        (("subscriber:a",), b"fap-frame/ab/", False),
        (("subscriber:a",), b"fap-frame/a", False),
        (("subscriber:a",), b"", False),
        (("subscriber:a",), b"\xff/a/", True),  # matches no message
    ],
)
def test_a_subscriber_follows_the_sessions_of_its_roles(
    roles: tuple[str, ...], topic: bytes, may: bool
) -> None:
    assert may_subscribe(Grant("name", roles), topic) == may
