"""Commands of an operator: load, unload, alias, rollback, canary, shadow; by a server or on a repository itself."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

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
    version: Any = None

    def words(self) -> str:
        """Return what follows the command and the policy's name."""
        return str(self.version or "")

    def change(self, name: str) -> Change:
        """Return what it does to a plan. Raises RequestError."""
        raise NotImplementedError

    async def give(self, control: Control, name: str, what: str) -> Plan:
        """Carry it out; return the plan with it. Raises what the control raises."""
        return await control.change(self.change(name), what=what)


class Load(Command):
    summary = "Load a version, prove it, and keep it ready: not in use until an alias leads to it"
    version: Version | None = Field(default=None, description="The repository's newest when left out.")

    def words(self) -> str:
        return self.version or "newest"

    async def give(self, control: Control, name: str, what: str) -> Plan:
        return await control.load(name, self.version, what=what)


class Unload(Command):
    summary = "Drop a version, or the policy"
    version: Version | None = Field(default=None, description="The whole policy when left out.")

    def change(self, name: str) -> Change:
        return partial(plan_changes.unload, name=name, version=self.version)


class SetAlias(Command):
    summary = "Let an alias lead to a loaded version"
    alias: Alias = Field(description="`production` is the default version; it can be moved, not removed.")
    version: Version | None = Field(description="A loaded version; null removes the alias.")
    expected: Version | None = Field(None, description="Where the alias leads now; when it does not, nothing changes.")

    def words(self) -> str:
        return f"{self.alias}={self.version or ''}"

    def change(self, name: str) -> Change:
        alias, version, expected = self.alias, self.version, self.expected
        return partial(plan_changes.set_alias, name=name, alias=alias, version=version, expected=expected)


class Rollback(Command):
    summary = "Let an alias lead where it led before"
    alias: Alias = Field(PRODUCTION, description="The alias; `production` when left out.")
    expected: Version | None = Field(
        None, description="Where the alias leads now; when it does not, nothing changes. Makes a repeated command safe."
    )

    def words(self) -> str:
        return self.alias

    def change(self, name: str) -> Change:
        return partial(plan_changes.roll_back, name=name, alias=self.alias, expected=self.expected)


class SetCanary(Command):
    summary = "Send a share of the sessions to another version"
    version: Reference | None = Field(description="A loaded version or an alias; null ends the canary.")
    share: float | None = Field(None, ge=0, le=1, description="Of the sessions; 0 ends the canary.")

    def words(self) -> str:
        return f"{self.version or 'off'} {self.share or ''}".strip()

    def change(self, name: str) -> Change:
        if self.version is not None and self.share is None:
            raise RequestError(f"the canary of policy '{name}' needs a share above 0 and at most 1")
        ended = self.version is None or not self.share
        canary = None if ended else Canary(version=str(self.version), share=self.share or 0)
        return partial(plan_changes.set_canary, name=name, canary=canary)


class SetShadow(Command):
    summary = "Let another version compute along"
    version: Reference | None = Field(description="A loaded version or an alias; null ends the shadow.")

    def words(self) -> str:
        return self.version or "off"

    def change(self, name: str) -> Change:
        return partial(plan_changes.set_shadow, name=name, shadow=self.version)


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
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise RequestError(f"{command}: {where}: {first['msg']} (given: {first['input']!r:.80})") from None
