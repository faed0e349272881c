"""Commands of an operator: load, unload, alias, rollback, canary, shadow; by a server or on a repository itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rlservo.export.contract.contract import first_fault
from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.versions import plan_changes
from rlservo.serve_app.versions.plan_writer import Change
from rlservo.serve_app.versions.serving_plan import PRODUCTION, Alias, Canary, Plan, PolicyPlan, Reference, Version


class Control(Protocol):
    """Writer of a plan: a process that serves it, or a writer alone."""

    async def load(self, name: str, version: str | None, *, what: str) -> Plan:
        """Find a version in the repository (None: the newest), and add it."""
        ...

    async def change(self, change: Change, *, what: str) -> Plan:
        """Make a change; `what` is kept as who did what."""
        ...


class Command(BaseModel):
    """One command on one policy."""

    model_config = ConfigDict(extra="forbid")
    summary: ClassVar[str]
    apply: ClassVar[Callable[..., dict[str, PolicyPlan]]]
    """What it does to a plan, given the policy's name and the fields."""

    version: Any = Field(None, exclude=True)  # of a command that takes none

    def words(self) -> str:
        """Return what follows the command and the policy's name."""
        return str(self.version or "")

    async def give(self, control: Control, name: str, what: str) -> Plan:
        """Carry it out; return the plan with it. Raises what the control raises."""
        return await control.change(partial(type(self).apply, name=name, **self.model_dump()), what=what)


class Load(Command):
    summary = "Load a version, prove it, and keep it ready: not in use until an alias leads to it"
    version: Version | None = Field(default=None, description="The repository's newest when left out.")

    def words(self) -> str:
        return self.version or "newest"

    async def give(self, control: Control, name: str, what: str) -> Plan:
        return await control.load(name, self.version, what=what)


class Unload(Command):
    summary = "Drop a version, or the policy"
    apply = plan_changes.unload
    version: Version | None = Field(default=None, description="The whole policy when left out.")


class SetAlias(Command):
    summary = "Let an alias lead to a loaded version"
    apply = plan_changes.set_alias
    alias: Alias = Field(description="`production` is the default version; it can be moved, not removed.")
    version: Version | None = Field(description="A loaded version; null removes the alias.")
    expected: Version | None = Field(None, description="Where the alias leads now; when it does not, nothing changes.")

    def words(self) -> str:
        return f"{self.alias}={self.version or ''}"


class Rollback(Command):
    summary = "Let an alias lead where it led before"
    apply = plan_changes.roll_back
    alias: Alias = Field(PRODUCTION, description="The alias; `production` when left out.")
    expected: Version | None = Field(
        None, description="Where the alias leads now; when it does not, nothing changes. Makes a repeated command safe."
    )

    def words(self) -> str:
        return self.alias


class SetCanary(Command):
    summary = "Send a share of the sessions to another version"
    apply = plan_changes.set_canary
    version: Reference | None = Field(description="A loaded version or an alias; null ends the canary.")
    share: float | None = Field(None, ge=0, le=1, description="Of the sessions; 0 ends the canary.")

    def words(self) -> str:
        return f"{self.version or 'off'} {self.share or ''}".strip()


class SetShadow(Command):
    summary = "Let another version compute along"
    apply = plan_changes.set_shadow
    version: Reference | None = Field(description="A loaded version or an alias; null ends the shadow.")

    def words(self) -> str:
        return self.version or "off"


COMMANDS: dict[str, type[Command]] = {
    "load": Load,
    "unload": Unload,
    "alias": SetAlias,
    "rollback": Rollback,
    "canary": SetCanary,
    "shadow": SetShadow,
}


class Changed(BaseModel):
    """State of a policy after a command."""

    generation: int = Field(description="The number of the plan with it.")
    policy: str
    default: str | None = Field(description="The default version; null when the policy is no longer served.")
    versions: list[str]
    aliases: dict[str, str]
    canary: Canary | None
    shadow: str | None

    @classmethod
    def of(cls, plan: Plan, name: str) -> Changed:
        """Return what a plan says of a policy."""
        policy = plan.policies.get(name) or PolicyPlan(versions={})
        return cls(
            generation=plan.generation,
            policy=name,
            default=policy.default,
            versions=list(policy.versions),
            aliases=policy.aliases,
            canary=policy.canary,
            shadow=policy.shadow,
        )


def parse(command: str, document: dict[str, Any]) -> Command:
    """Return a command from its fields. Raises RequestError."""
    try:
        return COMMANDS[command].model_validate(document)
    except ValidationError as error:
        raise RequestError(f"{command}: {first_fault(error, shows_input=True)}") from None
