"""The contract of a checkpoint: its form as JSON and the comparison with what runs."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from agent_client.contract import (
    Network,
    Normalisation,
    compare,
    from_json,
    require_match,
    running_contract,
    to_json,
)
from agent_client.errors import ContractMismatch, PolicyError
from agent_client.settings import ActionSettings, CameraSettings, LidarSettings, RewardSettings, Settings


def test_a_contract_survives_json_exactly() -> None:
    """Every float, name and nested setting comes back equal, an infinite clip included."""
    norm = Normalisation((0.1 + 0.2,) * 37, (1.0 / 3.0,) * 37, math.inf, 1e-8)
    contract = running_contract(
        Settings(masked_features=("progress",)),
        normalisation=norm,
        network=Network((256, 128), "tanh"),
        training={"seed": 1, "preset": "robust"},
    )
    assert from_json(to_json(contract), "x.zip") == contract


def test_the_contract_lists_37_observations_and_36_actions() -> None:
    """Names are unique and the table is 9 directions by 4 speeds, straight ahead first."""
    contract = running_contract()
    assert len(set(contract.observations)) == 37
    assert len(set(contract.actions)) == 36
    assert (contract.actions[0].alpha, contract.actions[0].beta) == (0.0, 0.0)
    assert len({(a.alpha, a.beta) for a in contract.actions}) == 9


def test_what_agrees_is_accepted() -> None:
    """The same settings differ in nothing; normalisation, mask, network and training are not compared."""
    trained = running_contract(
        Settings(masked_features=("progress",)),
        normalisation=Normalisation((0.5,) * 37, (2.0,) * 37, 5.0, 1e-8),
        network=Network((256, 128), "tanh"),
        training={"seed": 3},
    )
    assert require_match(trained, running_contract(), "x.zip") == ()


def test_the_reward_is_no_part_of_the_contract() -> None:
    """Settings that change neither what the policy sees nor what it does may differ."""
    assert compare(running_contract(), running_contract(Settings(reward=RewardSettings(success=300.0)))) == ()


@pytest.mark.parametrize(
    ("running", "message"),
    [
        (Settings(lidar=LidarSettings(rays=12)), "lidar.rays: expected 36, found 12"),
        (Settings(lidar=LidarSettings(reach=2.0)), "lidar.reach: expected 3, found 2"),
        (Settings(camera=CameraSettings(target_distance=4.0)), "camera.target_distance: expected 3, found 4"),
        (
            Settings(actions=ActionSettings(speeds=(0.5, 1.0, 1.5, 3.0))),
            "actions[3].speed: expected 2, found 3",
        ),
        (Settings(actions=ActionSettings(speeds=(1.0, 2.0))), "actions.count: expected 36, found 18"),
    ],
)
def test_a_mismatch_names_what_differs(running: Settings, message: str) -> None:
    """Sensors and actions other than the checkpoint's are refused with name, expected and found."""
    with pytest.raises(ContractMismatch) as caught:
        require_match(running_contract(), running_contract(running), "x.zip")
    assert message in str(caught.value)
    assert "x.zip" in str(caught.value)


def test_every_difference_is_listed() -> None:
    """Several differences are all in the exception, not the first alone."""
    running = running_contract(Settings(lidar=LidarSettings(rays=12, reach=2.0)), 0.05)
    with pytest.raises(ContractMismatch) as caught:
        require_match(running_contract(), running, "x.zip")
    assert [d.name for d in caught.value.differences] == ["dt", "lidar.rays", "lidar.reach"]


def test_a_message_lists_five_differences_and_counts_the_others() -> None:
    """The sentence stays readable; the exception's attribute keeps all."""
    contract = running_contract()
    running = replace(contract, observations=contract.observations[::-1])
    with pytest.raises(ContractMismatch, match=r"observations\[4\]: [^;]*; and 31 more$") as caught:
        require_match(contract, running, "x.zip")
    assert len(caught.value.differences) == 36
    assert str(caught.value).count("expected") == 5


def test_observation_names_and_order_count() -> None:
    """Two exchanged features are two differences."""
    contract = running_contract()
    names = (contract.observations[1], contract.observations[0], *contract.observations[2:])
    found = compare(contract, replace(contract, observations=names))
    assert [d.name for d in found] == ["observations[0]", "observations[1]"]


def test_an_allowed_difference_is_returned() -> None:
    """Another dt may be allowed by its name; it is returned to be recorded, and others stay refused."""
    contract, running = running_contract(), running_contract(dt=0.05)
    allowed = require_match(contract, running, "x.zip", allow={"dt"})
    assert [(d.name, d.expected, d.found) for d in allowed] == [("dt", "0.1", "0.05")]
    other = running_contract(Settings(lidar=LidarSettings(rays=12)), 0.05)
    with pytest.raises(ContractMismatch, match=r"lidar\.rays"):
        require_match(contract, other, "x.zip", allow={"dt"})


def test_a_setting_that_only_one_side_knows_is_a_difference() -> None:
    """A sensor setting that the running program does not have is refused, not ignored."""
    contract = running_contract()
    camera = {**contract.settings["camera"], "roll": 0.1}
    older = replace(contract, settings={**contract.settings, "camera": camera})
    assert [(d.name, d.found) for d in compare(older, contract)] == [("camera.roll", "no such term")]


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("dt",), -0.1, "dt: expected a number above 0, found -0.1"),
        (("normalisation", "mean"), [0.0], "normalisation.mean: expected 37 finite numbers"),
        (("normalisation", "variance"), [-1.0] * 37, "normalisation.variance"),
        (("masked",), ["no_such_feature"], "masked: expected names of observations"),
        (("network", "activation"), "elu", "network.activation: expected tanh or relu, found elu"),
        (("actions",), [{"alpha": 0.0}], "expected the field 'beta', found none"),
        (("settings",), 3, "wrong form"),
    ],
)
def test_a_contract_of_another_form_is_refused(path: tuple[str, ...], value: object, message: str) -> None:
    """A field that is missing or wrong is refused by its name."""
    tree = json.loads(to_json(running_contract(network=Network((4,), "tanh"))))
    target = tree
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(PolicyError) as caught:
        from_json(json.dumps(tree), "x.zip")
    assert message in str(caught.value)
