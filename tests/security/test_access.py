"""The table of who may publish what, against a second one written by hand, and Zenoh's section made from it."""

from __future__ import annotations

from typing import Any

import pytest
import zenoh

from wire.access import Message, access_control, names, peers_of, table
from wire.keys import Keys

KEYS = Keys(0x1234)
NODES = 5
ROOT = "octarm/0000000000001234"


def may_publish(sender: str, receiver: str, key: str, firsts: list[int]) -> bool:
    """Who may publish what, key by key, in words of strings."""
    words = key.removeprefix(ROOT + "/").split("/")
    number = next((int(word) for word in words if word.isdigit()), -1)
    owner = f"node-{max((f for f in firsts if f <= number), default=0)}"
    match words:
        case ["node", _, "measurement"]:
            return sender == "plant" and receiver == owner and number in firsts
        case ["node", _, "forward"]:
            return (
                number in firsts
                and number > 0
                and receiver == owner
                and sender == before(number, firsts)
            )
        case ["node", _, "backward"]:
            after = number + 1
            return after in firsts and receiver == owner and sender == f"node-{after}"
        case ["node", _, "state", own]:
            if number not in firsts or receiver != owner:
                return False
            from_left = number > 0 and int(own) == number - 1 and sender == before(number, firsts)
            after = min(f for f in [*firsts, NODES] if f > number)
            return from_left or (int(own) == after and sender == f"node-{after}")
        case ["plant", "command", _]:
            return receiver == "plant" and sender == owner and number in firsts
        case ["telemetry", "plant"]:
            return sender == "plant" and receiver in ("recorder", "live")
        case ["telemetry", _]:
            from_node = sender == owner and receiver == "plant"
            handed_on = sender == "plant" and receiver in ("recorder", "live")
            return number in firsts and (from_node or handed_on)
        case ["stop"]:
            return sender == "plant" and receiver.startswith("node")
    raise AssertionError(key)


def before(first: int, firsts: list[int]) -> str:
    return f"node-{firsts[firsts.index(first) - 1]}"


def all_keys() -> list[str]:
    return [
        KEYS.stop,
        KEYS.telemetry(-1),
        *(KEYS.state(i, j) for i in range(NODES) for j in range(NODES)),
        *(
            make(i)
            for make in (
                KEYS.measurement,
                KEYS.forward,
                KEYS.backward,
                KEYS.command,
                KEYS.telemetry,
            )
            for i in range(NODES)
        ),
    ]


def allows(section: dict[str, Any], peer: str, flow: str, message: str, key: str) -> bool:
    """What Zenoh makes of a section: an allowing rule must include the whole expression."""
    assert section["enabled"] and section["default_permission"] == "deny"
    assert {rule["permission"] for rule in section["rules"]} <= {"allow"}
    own = {rule for one in section["policies"] if peer in one["subjects"] for rule in one["rules"]}
    return any(
        zenoh.KeyExpr(expression).includes(zenoh.KeyExpr(key))
        for rule in section["rules"]
        if rule["id"] in own and flow in rule["flows"] and message in rule["messages"]
        for expression in rule["key_exprs"]
    )


@pytest.mark.parametrize("firsts", [[0, 1, 2, 3, 4], [0, 2, 4], [0, 3]])
@pytest.mark.parametrize("live", [False, True])
def test_only_who_should_can_publish(firsts: list[int], live: bool) -> None:
    said = list(table(KEYS, firsts, NODES, live=live))
    everybody = names(firsts, live=live)
    identities = {name: f"{number + 1:x}" for number, name in enumerate(everybody)}
    sections = {name: access_control(name, said, identities) for name in everybody}
    found = 0
    for sender in everybody:
        for receiver in everybody:
            if sender == receiver:
                continue
            for key in all_keys():
                expected = may_publish(sender, receiver, key, firsts)
                if receiver == "live" and not live:
                    expected = False
                assert allows(sections[receiver], sender, "ingress", "put", key) == expected, (
                    sender,
                    receiver,
                    key,
                )
                assert allows(sections[sender], receiver, "egress", "put", key) == expected
                assert not allows(sections[receiver], sender, "ingress", "delete", key)
                found += expected
            for wide in (f"{ROOT}/**", f"{ROOT}/node/*/forward", f"{ROOT}/plant/command/*", "**"):
                assert not allows(sections[receiver], sender, "ingress", "put", wide)
    assert found == sum(isinstance(one, Message) for one in said)


def test_only_a_node_holds_its_token() -> None:
    firsts = list(range(NODES))
    said = list(table(KEYS, firsts, NODES, live=True))
    identities = dict.fromkeys(names(firsts, live=True), "1")
    plant = access_control("plant", said, identities)
    for i in firsts:
        for j in firsts:
            mine = allows(plant, f"node-{i}", "ingress", "liveliness_token", KEYS.ready(j))
            assert mine == (i == j)
        assert allows(plant, "live", "egress", "liveliness_token", KEYS.ready(i))
        assert not allows(plant, "live", "ingress", "liveliness_token", KEYS.ready(i))
        assert not allows(plant, "recorder", "egress", "liveliness_token", KEYS.ready(i))
    for i in firsts:  # neighbours see each other's alone
        node = access_control(f"node-{i}", said, identities)
        for j in {i - 1, i + 1} & set(firsts):
            for token in firsts:
                seen = allows(node, f"node-{j}", "ingress", "liveliness_token", KEYS.ready(token))
                assert seen == (token == j)
                watch = "declare_liveliness_subscriber"
                shown = allows(node, f"node-{j}", "ingress", watch, KEYS.ready(token))
                assert shown == (token == i)


def test_every_key_of_the_run_is_in_the_table() -> None:
    """One that is forgotten here would be silent in a run with keys, and only there."""
    firsts = list(range(NODES))
    said = [one.key for one in table(KEYS, firsts, NODES, live=True)]
    methods = [name for name in vars(Keys) if not name.startswith(("_", "all_"))]
    for name in set(methods) - {"root", "run"}:
        method = getattr(KEYS, name)
        more = (0,) if name == "state" else ()
        assert any((method(i, *more) if callable(method) else method) in said for i in firsts), name


def test_a_subject_has_both_certificate_and_number() -> None:
    said = list(table(KEYS, [0, 1], 2, live=False))
    section = access_control("node-1", said, {"plant": "aa", "node-0": "bb", "recorder": "cc"})
    assert peers_of("node-1", said) == ["node-0", "plant"]
    assert section["subjects"] == [
        {"id": "node-0", "cert_common_names": ["node-0"], "zids": ["bb"]},
        {"id": "plant", "cert_common_names": ["plant"], "zids": ["aa"]},
    ]
