import dataclasses
import json
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from famle_envs import Situation
from famle_envs.situation import resolve_situation

FINITE = st.floats(allow_nan=False, allow_infinity=False)
ANGLES = FINITE
MULTIPLIERS = st.floats(min_value=0.0, exclude_min=True, allow_infinity=False)
SITUATIONS = st.builds(
    Situation,
    motor_gain=st.lists(st.floats(-1.0, 1.0) | st.sampled_from([-1, 0, 1]), max_size=6),
    locked_joints=st.lists(st.integers(0, 6), max_size=4),
    joint_offset=st.lists(ANGLES | st.sampled_from([0.0, math.radians(30.0)]), max_size=6),
    orientation_error=ANGLES,
    friction=MULTIPLIERS | st.just(1.0),
    base_mass=MULTIPLIERS | st.just(1.0),
    name=st.text(max_size=8),
    motor_strength=st.lists(MULTIPLIERS, max_size=3),
    motor_delay=st.lists(st.integers(0, 1000), max_size=3),
    motor_stuck=st.lists(st.none() | FINITE, max_size=3),
    sensor_gain=st.lists(FINITE | st.sampled_from([-1, 0, 1]), max_size=3),
    sensor_offset=st.lists(FINITE, max_size=3),
    sensor_noise=st.lists(st.floats(min_value=0.0, allow_infinity=False), max_size=3),
    sensor_delay=st.lists(st.integers(0, 1000), max_size=3),
    sensor_dropout=st.lists(st.floats(0.0, 1.0) | st.just(1), max_size=3),
    mass=MULTIPLIERS | st.just(1.0),
    body_mass=st.lists(MULTIPLIERS, max_size=3),
    damping=MULTIPLIERS | st.just(1.0),
)
ONE_OF_EACH_FAULT = {
    "motor_gain": Situation(partial=True, motor_gain=(1, 0.5)),
    "locked_joints": Situation(locked_joints=(2,)),
    "joint_offset": Situation(joint_offset=(0.0, 0.1)),
    "orientation_error": Situation(orientation_error=0.3),
    "friction": Situation(friction=2.0),
    "base_mass": Situation(base_mass=1.5),
    "motor_strength": Situation(motor_strength=(1, 1.5)),
    "motor_delay": Situation(motor_delay=(0, 2)),
    "motor_stuck": Situation(motor_stuck=(None, 0)),
    "sensor_gain": Situation(sensor_gain=(1, 0.5)),
    "sensor_offset": Situation(sensor_offset=(0, 0.1)),
    "sensor_noise": Situation(sensor_noise=(0, 0.1)),
    "sensor_delay": Situation(sensor_delay=(0, 2)),
    "sensor_dropout": Situation(sensor_dropout=(0, 0.2)),
    "mass": Situation(mass=1.5),
    "body_mass": Situation(body_mass=(1, 1.5)),
    "damping": Situation(damping=2.0),
}
PRESETS = {
    "intact": Situation(name="intact"),
    "paper": Situation(motor_gain=(-1, 1, 1, 0, 1), name="paper"),
    "joint 0 dead": Situation(motor_gain=(0,), name="joint 0 dead"),
}
properties = settings(max_examples=80, deadline=None)


@properties
@given(SITUATIONS)
def test_dict_round_trip_through_json_keeps_faults_and_name(situation: Situation) -> None:
    restored = Situation.from_dict(json.loads(json.dumps(situation.to_dict())))
    assert restored == situation
    assert restored.name == situation.name


@properties
@given(SITUATIONS)
def test_description_reads_back_as_the_same_situation(situation: Situation) -> None:
    assert Situation.from_string(str(situation)) == situation


@properties
@given(SITUATIONS, st.integers(0, 3), st.text(max_size=8))
def test_equality_and_hash_ignore_the_name_and_trailing_joints_as_built(
    situation: Situation, more: int, name: str
) -> None:
    longer = dataclasses.replace(
        situation,
        motor_gain=situation.motor_gain + (1.0,) * more,
        joint_offset=situation.joint_offset + (0.0,) * more,
        name=name,
    )
    assert longer == situation
    assert hash(longer) == hash(situation)


@properties
@given(SITUATIONS, SITUATIONS)
def test_equal_situations_have_equal_hashes_and_descriptions(first: Situation, second: Situation) -> None:
    assert (first == second) == (str(first) == str(second))
    assert first != second or hash(first) == hash(second)


def test_negative_zero_is_the_same_fault_as_zero() -> None:
    negative, zero = Situation(motor_gain=(-0.0,)), Situation(motor_gain=(0.0,))
    assert negative == zero
    assert hash(negative) == hash(zero)
    assert str(negative) == str(zero) == "joint 0 dead"


@pytest.mark.parametrize("field", ONE_OF_EACH_FAULT)
def test_every_field_but_the_name_takes_part_in_equality(field: str) -> None:
    others = [situation for name, situation in ONE_OF_EACH_FAULT.items() if name != field]
    assert ONE_OF_EACH_FAULT[field] not in [Situation(), *others]
    assert ONE_OF_EACH_FAULT[field].faults == {field}
    assert not ONE_OF_EACH_FAULT[field].is_intact


def test_intact_robot_has_no_faults() -> None:
    as_built = Situation(motor_gain=(1, 1), joint_offset=(0, 0), name="fine")
    assert as_built.is_intact
    assert as_built.faults == frozenset()
    assert as_built == Situation()


def test_situation_is_not_equal_to_its_description() -> None:
    assert Situation() != "intact"


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Situation)])
def test_fields_cannot_be_assigned(field: str) -> None:
    situation = Situation(motor_gain=(0,))
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(situation, field, getattr(situation, field))


def test_later_changes_of_the_arguments_do_not_reach_the_situation() -> None:
    gain, locked = np.array([1.0, 0.0]), [1]
    situation = Situation(motor_gain=gain, locked_joints=locked)
    gain[:] = 1.0
    locked.append(2)
    assert situation == Situation(motor_gain=(1, 0), locked_joints=(1,))


def test_locked_joints_are_sorted_and_unique() -> None:
    assert Situation(locked_joints=(3, 1, 3)).locked_joints == (1, 3)


@pytest.mark.parametrize(
    ("situation", "text"),
    [
        (Situation(), "intact"),
        (Situation(motor_gain=(-1, 1, 1, 0, 1)), "joint 0 reversed, joint 3 dead"),
        (Situation(motor_gain=(1, 0.25)), "joint 1 at gain 0.25"),
        (Situation(locked_joints=(4, 2)), "joint 2 locked, joint 4 locked"),
        (Situation(joint_offset=(0.0, math.radians(10.0))), "joint 1 sensor off by 10 deg"),
        (Situation(joint_offset=(-0.1,)), "joint 0 sensor off by -0.1 rad"),
        (Situation(orientation_error=math.radians(-30.0)), "yaw sensor off by -30 deg"),
        (Situation(friction=0.5, base_mass=2.0), "friction x 0.5, base mass x 2"),
        (Situation(motor_strength=(1, 1.5)), "motor 1 strength x 1.5"),
        (Situation(motor_delay=(1, 2)), "motor 0 delayed by 1 step, motor 1 delayed by 2 steps"),
        (Situation(motor_stuck=(None, -0.5)), "motor 1 stuck at -0.5"),
        (Situation(sensor_gain=(0, -1, 2)), "sensor 0 dead, sensor 1 reversed, sensor 2 at gain 2"),
        (Situation(sensor_offset=(0.1,), sensor_noise=(0.2,)), "sensor 0 off by 0.1, sensor 0 noise 0.2"),
        (Situation(sensor_delay=(0, 3)), "sensor 1 delayed by 3 steps"),
        (Situation(sensor_dropout=(1, 0.2)), "sensor 0 frozen, sensor 1 loses 0.2 of its readings"),
        (Situation(mass=2, body_mass=(1, 0.5), damping=3), "body 1 mass x 0.5, mass x 2, damping x 3"),
    ],
    ids=str,
)
def test_description_is_readable(situation: Situation, text: str) -> None:
    assert str(situation) == text
    assert Situation.from_string(text) == situation


@pytest.mark.parametrize(
    ("written", "printed"),
    [
        ("motor 3 dead", "joint 3 dead"),
        ("motor 1 at gain 0.5", "joint 1 at gain 0.5"),
        ("joint 0 dead + joint 1 dead", "joint 0 dead, joint 1 dead"),
    ],
)
def test_other_ways_to_write_a_description_are_read(written: str, printed: str) -> None:
    assert str(Situation.from_string(written)) == printed


def test_label_is_the_name_or_else_the_description() -> None:
    assert Situation(motor_gain=(0,), name="broken shoulder").label == "broken shoulder"
    assert Situation(motor_gain=(0,)).label == "joint 0 dead"


def test_to_dict_holds_only_the_faults_and_the_name() -> None:
    assert Situation(motor_gain=(1, 0, 1), friction=1.0).to_dict() == {"motor_gain": [1.0, 0.0, 1.0]}
    assert Situation(name="fine").to_dict() == {"name": "fine"}


@pytest.mark.parametrize("gain", [1.001, -1.001, 2, math.nan, math.inf])
def test_gain_outside_its_range_is_refused(gain: float) -> None:
    with pytest.raises(ValueError, match="motor_gain must"):
        Situation(motor_gain=(1.0, gain))


@pytest.mark.parametrize("field", ["orientation_error", "friction", "base_mass"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_value_that_is_not_finite_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} must be finite"):
        Situation(**{field: value})


@pytest.mark.parametrize("field", ["friction", "base_mass"])
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_multiplier_not_above_zero_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} .* above 0"):
        Situation(**{field: value})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"motor_strength": (0,)}, "motor_strength .* above 0"),
        ({"motor_delay": (1.5,)}, "whole numbers of steps, 0 to 1000, got 1.5"),
        ({"sensor_delay": (-1,)}, "whole numbers of steps"),
        ({"sensor_delay": (1001,)}, "whole numbers of steps"),
        ({"motor_stuck": (math.nan,)}, "motor_stuck must be finite"),
        ({"sensor_gain": (math.inf,)}, "sensor_gain must be finite"),
        ({"sensor_noise": (-0.1,)}, "at least 0, got -0.1"),
        ({"sensor_dropout": (1.1,)}, r"probabilities in \[0, 1\]"),
        ({"body_mass": (1, -1)}, "body_mass .* above 0"),
        ({"mass": 0}, "mass .* above 0"),
        ({"damping": -1}, "damping .* above 0"),
    ],
)
def test_values_that_cannot_be_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Situation(**values)


@pytest.mark.parametrize("joint", [-1, 1.5])
def test_locked_joint_that_is_no_index_is_refused(joint: float) -> None:
    with pytest.raises(ValueError, match="locked_joints must hold joint indices"):
        Situation(locked_joints=(joint,))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("motor_gain", 0.5),
        ("motor_gain", None),
        ("motor_gain", "dead"),
        ("motor_gain", ("0.5",)),
        ("motor_gain", ([0.5],)),
        ("motor_gain", {0: -1.0}),
        ("joint_offset", 0.1),
        ("joint_offset", (None,)),
        ("locked_joints", 3),
        ("locked_joints", "12"),
        ("orientation_error", "north"),
        ("orientation_error", (0.1,)),
        ("friction", None),
        ("friction", "2"),
        ("base_mass", [2.0]),
        ("name", 3),
    ],
)
def test_value_of_the_wrong_type_is_refused_by_field(field: str, value: object) -> None:
    with pytest.raises(TypeError, match=field):
        Situation(**{field: value})


@pytest.mark.parametrize(
    ("key", "meant"), [("motor_gains", "motor_gain"), ("lock_joints", "locked_joints"), ("base_mas", "base_mass")]
)
def test_unknown_field_is_refused_with_a_suggestion(key: str, meant: str) -> None:
    with pytest.raises(ValueError, match=f"no field '{key}'; did you mean '{meant}'"):
        Situation.from_dict({key: 1.0})


def test_unknown_field_unlike_any_other_is_refused_with_the_list_of_fields() -> None:
    with pytest.raises(ValueError, match=r"no field 'zzz'\. Fields: motor_gain, .*base_mass, name"):
        Situation.from_dict({"zzz": 1.0})


@pytest.mark.parametrize(
    "clause",
    [
        *("", "joint 3", "joint dead", "joint -1 dead", "joint 1 at gain full", "yaw sensor off by 3"),
        *("sensor 1 off by 3 deg", "motor 2 delayed by 1.5 steps", "motor ٣ dead", "joint 1\ndead", "joint 1 détruit"),
    ],
)
def test_clause_that_cannot_be_read_is_refused_with_an_example(clause: str) -> None:
    with pytest.raises(ValueError, match=f"Cannot read {re.escape(repr(clause))}. Write faults like"):
        Situation.from_string(f"joint 0 dead, {clause}")


@properties
@given(st.floats(-1e6, 1e6))
@example(math.pi)
@example(-math.pi)
@example(math.nextafter(math.pi, math.inf))
@example(math.nextafter(-math.pi, -math.inf))
@example(math.nextafter(3 * math.pi, math.inf))
def test_orientation_error_is_the_same_angle_in_half_open_interval(angle: float) -> None:
    kept = Situation(orientation_error=angle).orientation_error
    assert -math.pi < kept <= math.pi
    assert math.cos(kept - angle) == pytest.approx(1.0)


def test_orientation_errors_a_turn_apart_are_equal() -> None:
    assert Situation(orientation_error=math.pi) == Situation(orientation_error=-math.pi)
    assert Situation(orientation_error=2 * math.pi).is_intact


def test_for_robot_completes_the_tuples_and_keeps_the_rest() -> None:
    complete = Situation(partial=True, motor_gain=(0.5,), locked_joints=(2,), name="x").for_robot(
        "Arm", 3, frozenset({"motor_gain", "locked_joints"})
    )
    assert complete.motor_gain == (0.5, 1.0, 1.0)
    assert complete.joint_offset == (0.0, 0.0, 0.0)
    assert complete.locked_joints == (2,)
    assert complete.name == "x"


@pytest.mark.parametrize("field", ONE_OF_EACH_FAULT)
def test_for_robot_refuses_an_unsupported_fault_by_name(field: str) -> None:
    supported = frozenset(ONE_OF_EACH_FAULT) - {field}
    with pytest.raises(ValueError, match=f"Arm cannot have the fault '{field}'"):
        ONE_OF_EACH_FAULT[field].for_robot("Arm", 3, supported)
    complete = ONE_OF_EACH_FAULT[field].for_robot("Arm", 3, frozenset({field}), n_sensors=2, n_bodies=2)
    assert complete == ONE_OF_EACH_FAULT[field]


@pytest.mark.parametrize("field", ["sensor_gain", "body_mass"])
def test_for_robot_refuses_more_values_than_sensors_or_bodies(field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} speaks of 4 .*; those of Arm are 0 to 1"):
        Situation(**{field: (0.5,) * 4}).for_robot("Arm", 3, frozenset({field}), n_sensors=2, n_bodies=2)


@pytest.mark.parametrize("field", ["motor_gain", "joint_offset"])
def test_for_robot_refuses_more_values_than_joints(field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} speaks of 4 joints; those of Arm are 0 to 2"):
        Situation(**{field: (0.5,) * 4}).for_robot("Arm", 3, frozenset({field}))


def test_for_robot_refuses_a_joint_that_does_not_exist() -> None:
    with pytest.raises(ValueError, match="names joint 3; the joints of Arm are 0 to 2"):
        Situation(locked_joints=(0, 3)).for_robot("Arm", 3, frozenset({"locked_joints"}))


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        (None, Situation()),
        (Situation(friction=2), Situation(friction=2)),
        ({"motor_gain": [1, 0]}, Situation(motor_gain=(1, 0))),
        ({}, Situation()),
        ("paper", PRESETS["paper"]),
        ("joint 1 locked", Situation(locked_joints=(1,))),
    ],
    ids=str,
)
def test_resolve_accepts_all_ways_to_write_a_situation(written: object, meant: Situation) -> None:
    assert resolve_situation(written, PRESETS) == meant


def test_resolve_prefers_a_preset_to_a_description_of_the_same_text() -> None:
    assert resolve_situation("joint 0 dead", PRESETS) is PRESETS["joint 0 dead"]


def test_resolve_refuses_an_unknown_name_with_a_suggestion_and_all_presets() -> None:
    with pytest.raises(ValueError, match=r"'papr'; did you mean 'paper'\? Presets: intact; paper; joint 0 dead"):
        resolve_situation("papr", PRESETS)


@pytest.mark.parametrize("written", [3, 0.5, ["joint 0 dead"], ("motor_gain", 1), b"paper", True])
def test_resolve_refuses_other_types(written: object) -> None:
    with pytest.raises(TypeError, match=f"got {type(written).__name__}"):
        resolve_situation(written, PRESETS)


def test_motor_gain_that_leaves_joints_out_is_refused_unless_it_says_so() -> None:
    known = frozenset({"motor_gain"})
    with pytest.raises(ValueError, match=r"2 of the 3 joints of Arm.*'joint 1 at gain 0\.5'.*partial=True"):
        Situation(motor_gain=(1, 0.5)).for_robot("Arm", 3, known)
    for situation in (Situation(motor_gain=(1, 0.5), partial=True), Situation.from_string("joint 1 at gain 0.5")):
        for again in (situation, Situation.from_dict(json.loads(json.dumps(situation.to_dict())))):
            assert again.for_robot("Arm", 3, known).motor_gain == (1.0, 0.5, 1.0)
    assert Situation(motor_gain=(1, 1)).for_robot("Arm", 3, known).is_intact


def test_partial_is_no_fault() -> None:
    assert Situation(partial=True) == Situation()
    assert Situation(motor_gain=(0,), partial=True).to_dict() == {"motor_gain": [0.0], "partial": True}
    with pytest.raises(TypeError, match="partial must be True or False"):
        Situation(partial="yes")  # type: ignore[arg-type]


# --- text of any length -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        f"friction x {'1' * 50_000}z",
        f"friction x {'1' * 50_000}",
        f"joint {'1' * 50_000} dead",
        f"motor 0 delayed by {'1' * 50_000} steps",
        f"sensor 0 noise 0.{'1' * 50_000}e",
        ",".join(["joint 1"] * 5_000),
        " " * 50_000,
    ],
    ids=lambda text: text[:20],
)
def test_long_text_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        Situation.from_string(text)  # which takes minutes where the time grows with the square of the length


def test_many_parts_are_read() -> None:
    assert Situation(motor_gain=(0.0, *(1.0,) * 200_000)) == Situation(motor_gain=(0.0,))
