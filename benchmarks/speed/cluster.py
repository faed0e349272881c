"""A Ray cluster on which deploy/serve.yaml is deployed as an operator does it, by `serve deploy`, again and again.

The head node is `head.py`. The variables it runs with are those of `rlservo cluster env`, with ports and folders of its
own.
"""

from __future__ import annotations

import json
import secrets
import subprocess
import sys
from dataclasses import dataclass, field
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import yaml

from rlservo.serve_app.ray_serve.environment import cluster_environment, proxy_files, proxy_ports
from rlservo.serve_app.ray_serve.ports import free_ports
from speed.catalogue import Case, asked
from speed.servers import Server, environment

ROOT = Path(__file__).resolve().parent.parent.parent
HEAD = Path(__file__).with_name("head.py")
SHIPPED = ROOT / "deploy" / "serve.yaml"
DEPLOY_S = 180.0


@dataclass
class Cluster:
    """The head node, and the configuration that was last deployed on it."""

    server: Server
    dashboard: int
    folder: Path
    variables: dict[str, str]
    configuration: dict[str, Any] = field(default_factory=dict)
    host: str = "127.0.0.1"
    """Where the head's dashboard listens."""

    @property
    def application(self) -> dict[str, Any]:
        found: dict[str, Any] = self.configuration["applications"][0]
        return found

    def deploy(self) -> tuple[bool, str]:
        """`serve deploy` what the configuration says; return whether the command took it, and what it said."""
        file = self.folder / "serve.yaml"
        file.write_text(yaml.safe_dump(self.configuration))
        command = [sys.executable, "-m", "ray.serve.scripts", "deploy", str(file)]
        done = subprocess.run(
            [*command, "-a", f"http://{self.host}:{self.dashboard}"],
            env=environment("", self.variables), cwd=self.folder, capture_output=True, text=True, timeout=DEPLOY_S,
        )  # fmt: skip
        return done.returncode == 0, done.stdout + done.stderr

    def status(self) -> dict[str, Any]:
        """Return what `serve status` tells of the application."""
        connection = HTTPConnection(self.host, self.dashboard, timeout=30)
        try:
            headers = {"Authorization": f"Bearer {self.variables['RAY_AUTH_TOKEN']}"}
            connection.request("GET", "/api/serve/applications/", headers=headers)
            document = json.loads(connection.getresponse().read())
        finally:
            connection.close()
        found: dict[str, Any] = document["applications"].get("rlservo", {})
        return found

    def replicas(self) -> list[str]:
        """Return the replicas that run."""
        deployments = self.status().get("deployments", {}).values()
        return [one["replica_id"] for each in deployments for one in each["replicas"] if one["state"] == "RUNNING"]

    def replicas_at(self) -> set[str]:
        """Return the addresses of the nodes that have a replica."""
        deployments = self.status().get("deployments", {}).values()
        return {one["node_ip"] for each in deployments for one in each["replicas"] if one["state"] == "RUNNING"}


def cluster(case: Case, policies: Path, folder: Path, *, cpus: int = 4) -> Cluster:
    """Return a cluster that is not started yet, and the shipped configuration with these policies in it."""
    port, grpc_port, dashboard = free_ports(3)
    home = folder / "c"
    home.mkdir()
    plan = {"dashboard": dashboard, "folder": str(home / "r"), "cpus": cpus}
    variables = cluster_environment(home) | replica_ports() | proxy_ports() | proxy_files(home)
    variables["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    configuration = yaml.safe_load(SHIPPED.read_text())
    configuration["http_options"]["port"] = port
    configuration["grpc_options"]["port"] = grpc_port
    configuration["applications"][0]["args"] = {"policies": [str(policies)]}
    server = asked(case, "serve deploy", [sys.executable, str(HEAD), json.dumps(plan)], port)
    server.grpc_port = grpc_port
    server.env = variables
    return Cluster(server, dashboard, home, variables, configuration)


def replica_ports() -> dict[str, str]:
    """Return ranges that no other Ray cluster on this machine uses: those of all clusters are the same by default."""
    first = 29_000 + 8 * secrets.randbelow(40)
    return {
        f"RAY_SERVE_DIRECT_INGRESS_{bound}_{protocol}_PORT": str(first + start + more)
        for protocol, start in (("HTTP", 0), ("GRPC", 500))
        for bound, more in (("MIN", 0), ("MAX", 63))
    }
