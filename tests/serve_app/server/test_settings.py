"""Sources of settings, and the message of a wrong one."""

from __future__ import annotations

import pytest

from rlservo.errors import UsageError
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings


def test_arguments_win_over_the_environment_over_the_defaults() -> None:
    environment = {"RLSERVO_THREADS": "3", "RLSERVO_MAX_BATCH": "7", "RLSERVO_SOMETHING_ELSE": "x"}
    settings = ServerSettings.from_environment({"threads": 2}, environment=environment)
    assert (settings.threads, settings.max_batch, settings.max_streams) == (2, 7, 256)


@pytest.mark.parametrize(
    ("given", "environment", "sentence"),
    [
        ({}, {"RLSERVO_THREADS": "many"}, "RLSERVO_THREADS is not usable"),
        ({"threads": 0}, {}, "the setting 'threads' is not usable"),
        (
            {},
            {"RLSERVO_POLICY_OPTIONS": '{"ur5": {"out_of_bound": 16}}'},
            r"RLSERVO_POLICY_OPTIONS is not usable at 'ur5.out_of_bound': .*known: out_of_bounds, .*, record$",
        ),
        ({"colour": 1}, {}, "known: threads"),
        ({}, {"RLSERVO_SESSION_STORE": "redis:/x"}, "RLSERVO_SESSION_STORE is not usable: expected memory, or a URL"),
    ],
)
def test_a_setting_that_cannot_be_used_is_named(
    given: dict[str, object], environment: dict[str, str], sentence: str
) -> None:
    with pytest.raises(UsageError, match=sentence):
        ServerSettings.from_environment(given, environment=environment)


def test_a_key_put_where_its_hash_belongs_is_not_shown() -> None:
    key, _ = new_key("operator", admin=True)
    with pytest.raises(UsageError, match="RLSERVO_OPERATOR_KEY is not usable") as caught:
        ServerSettings.from_environment(environment={"RLSERVO_OPERATOR_KEY": key})
    assert key not in caught.value.message
