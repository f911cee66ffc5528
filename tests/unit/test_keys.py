"""Keys in files: made once, private, allowed and revoked."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.keys import (
    MAX_KEYS,
    MAX_ROLES,
    Guest,
    add_guest,
    key_folder,
    may_follow,
    own_key,
    read_guests,
    refusal,
    revoke_guest,
    save_guests,
    user_key,
)
from kouxing.shared.wire.codec import decode, encode
from kouxing.shared.wire.control import AllowedKey, HeartbeatReply
from kouxing.shared.wire.message import MAX_MESSAGE_BYTES

pytestmark = pytest.mark.unit


@pytest.fixture(autouse=True)
def _new_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def test_the_first_use_makes_keys_that_only_their_owner_can_read() -> None:
    key = own_key("lamp", ("service:lamp",))
    assert own_key("lamp", ("service:lamp",)) == key
    assert key.control == own_key("control", ()).public != key.public
    assert read_guests() == {key.public: Guest("lamp", ("service:lamp",))}
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in key_folder().iterdir()}
    assert modes == dict.fromkeys(("control.key", "lamp.key", "allowed"), 0o600)
    assert stat.S_IMODE(key_folder().stat().st_mode) == 0o700


def test_processes_that_start_together_make_one_key() -> None:
    program = "from kouxing.shared.keys import user_key; print(user_key())"
    started = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) for _ in range(4)
    ]
    assert len({process.communicate()[0] for process in started}) == 1
    assert [guest.name for guest in read_guests().values()] == ["client"]


@pytest.mark.parametrize("name", ["", "client.key", "allowed"])
def test_what_others_can_read_or_own_is_refused(name: str) -> None:
    user_key()
    path = key_folder() / name
    path.chmod(0o750)
    with pytest.raises(UserError, match=f"others can read {path}; 'chmod [67]00 "):
        (user_key(), read_guests())
    path.chmod(0o700)
    os.chown(path, os.geteuid() + 1, -1)
    with pytest.raises(UserError, match=f"{path} belongs to another user"):
        (user_key(), read_guests())


@pytest.mark.parametrize("text", ["", "{}", '{"public": 1, "secret": 2, "control": 3}', "é"])
def test_a_file_that_is_no_key_is_named(text: str) -> None:
    user_key()
    (key_folder() / "client.key").write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=r"client\.key"):
        user_key()


def test_a_folder_without_a_home_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(UserError, match="XDG_STATE_HOME"):
        user_key()


def test_without_a_home_a_folder_must_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", no_home)
    with pytest.raises(UserError, match="XDG_STATE_HOME"):
        user_key()


def test_a_key_that_cannot_be_written_is_not_allowed(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "laptop.key"
    with pytest.raises(UserError, match=f"{path}: cannot be written"):
        add_guest("laptop", ("client",), path)
    assert read_guests() == {}


def test_an_added_key_works_on_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = tmp_path / "given.key"
    add_guest("laptop", ("client",), given)
    (public,) = read_guests()
    control = own_key("control", ())
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    key_folder().mkdir(parents=True, mode=0o700)
    given.rename(key_folder() / "client.key")
    assert (user_key().public, user_key().control) == (public, control.public)
    with pytest.raises(UserError, match="kouxing keys add NAME --role service:lamp"):
        own_key("lamp", ("service:lamp",))
    save_guests({public: Guest("laptop", ("client",))})
    assert read_guests() == {public: Guest("laptop", ("client",))}


@pytest.mark.parametrize(
    ("control", "said"),
    [("tcp://host:5550 key", "driver.key"), ("tcp://host:5550", "insecure = true is set here")],
)
def test_a_refusal_names_control_and_what_it_may_lack(control: str, said: str) -> None:
    text = refusal(control, "driver", ("service:driver",))
    assert "control at tcp://host:5550 " in text
    assert said in text


def test_a_credential_counts_instead_of_an_own_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, guests = own_key("lamp", ("service:lamp",)), read_guests()
    secrets = tmp_path / "secrets"
    secrets.mkdir()
    for name in ("lamp.key", "allowed"):
        (key_folder() / name).rename(secrets / name)
        (secrets / name).chmod(0o440)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "empty"))
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", f"{secrets}/")
    assert own_key("lamp", ()) == key
    assert read_guests() == guests
    assert not key_folder().exists(), "nothing need be written"
    (secrets / "lamp.key").chmod(0o444)
    with pytest.raises(UserError, match="others can read"):
        own_key("lamp", ())


def test_on_controls_machine_only_commands_change_the_list(tmp_path: Path) -> None:
    add_guest("laptop", ("client",), tmp_path / "laptop.key")
    before = read_guests()
    save_guests({})  # told by control before it saw the new key
    assert read_guests() == before


def test_a_revoked_key_is_allowed_no_longer_and_its_name_is_free(tmp_path: Path) -> None:
    add_guest("laptop", ("client",), tmp_path / "1")
    with pytest.raises(UserError, match="kouxing keys revoke laptop"):
        add_guest("laptop", ("client",), tmp_path / "2")
    revoke_guest("laptop")
    assert read_guests() == {}
    with pytest.raises(UserError, match="no key is called 'laptop'"):
        revoke_guest("laptop")
    add_guest("laptop", ("client",), tmp_path / "2")


@pytest.mark.parametrize(("name", "role"), [("a b", "client"), ("a", "root"), ("a", "service:")])
def test_a_wrong_name_or_role_is_refused(tmp_path: Path, name: str, role: str) -> None:
    with pytest.raises(UserError, match=role if name == "a" else name):
        add_guest(name, (role,), tmp_path / "new")


def test_more_roles_than_services_can_be_told_are_refused(tmp_path: Path) -> None:
    roles = [f"subscriber:s{number}" for number in range(MAX_ROLES + 1)]
    add_guest("few", roles[1:], tmp_path / "few.key")
    before = read_guests()
    with pytest.raises(UserError, match="many has 17 roles, a key may have 16"):
        add_guest("many", roles, tmp_path / "many.key")
    assert read_guests() == before
    assert not (tmp_path / "many.key").exists()


@pytest.mark.parametrize(
    ("roles", "number"),
    [(["client"], MAX_KEYS - 1), ([f"subscriber:{n:064}" for n in range(MAX_ROLES)], 580)],
)
def test_more_keys_than_services_can_be_told_are_refused_and_may_be_revoked(
    tmp_path: Path, roles: list[str], number: int
) -> None:
    lines = [f"{n:040} name-{n:055} {' '.join(roles)}\n" for n in range(number + 20)]
    add_guest("first", ("client",), tmp_path / "first.key")
    allowed = key_folder() / "allowed"
    with allowed.open("a", encoding="ascii") as file:
        file.writelines(lines[:number])
    told = HeartbeatReply(
        sent_ns=0,
        received_ns=0,
        replied_ns=0,
        control="control-1",
        keys={
            public: AllowedKey(name=guest.name, roles=list(guest.roles))
            for public, guest in read_guests().items()
        },
    )
    assert decode(encode(told)) == told
    assert sum(map(len, encode(told))) < MAX_MESSAGE_BYTES
    with allowed.open("a", encoding="ascii") as file:
        file.writelines(lines[number:])
    with pytest.raises(UserError, match=f"{allowed}: .*'kouxing keys revoke' some"):
        read_guests()
    with pytest.raises(UserError, match="'kouxing keys revoke' some"):
        add_guest("last", roles, tmp_path / "last.key")
    revoke_guest("first")


@pytest.mark.parametrize(
    ("roles", "topic", "may"),
    [
        (("client",), b"", True),
        (("service:lamp",), b"fap-frame/", True),
        (("subscriber:*",), b"fap-frame/", True),
        (("subscriber:a",), b"fap-frame/a/", True),
        (("subscriber:a", "subscriber:a"), b"fap-frame/b/", False),
        (("subscriber:a", "subscriber:b"), b"sound/b/", True),
        (("subscriber:a",), b"fap-frame/ab/", False),
        (("subscriber:a",), b"fap-frame/a", False),
        (("subscriber:a",), b"fap-frame/", False),
        (("subscriber:a",), b"", False),
        (("subscriber:a",), b"\xff/a/", True),  # matches no message
    ],
)
def test_a_subscriber_follows_the_sessions_of_its_roles(
    roles: tuple[str, ...], topic: bytes, may: bool
) -> None:
    assert may_follow(Guest("name", roles), topic) == may
