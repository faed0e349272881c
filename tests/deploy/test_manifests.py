"""The files that run the server on Kubernetes, with compose and in an image, against the schemas of what reads them."""

from __future__ import annotations

import configparser
import copy
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import yaml
from compose_spec import PyCompose

from clusters import SWITCHES
from documents import HOW_TO, blocks
from rayservice_schema import POD_MONITOR, RAY_SERVICE
from rlservo.serve_app.server.api_keys import Keys, new_key
from rlservo.serve_app.server.settings import PREFIX, ServerSettings
from rlservo.serve_app.versions.deployment_plan import ServedConfig
from servers import free_ports, running

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
KUBERAY = DEPLOY / "kuberay"
OUR_SCHEMAS = {"RayService": RAY_SERVICE, "PodMonitor": POD_MONITOR}


def program(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def documents(file: Path) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(file.read_text()))


def objects() -> Iterator[tuple[str, dict[str, Any]]]:
    for file in sorted(KUBERAY.glob("*.yaml")):
        if file.name != "kustomization.yaml":
            for document in documents(file):
                yield f"{file.name}:{document['kind']}/{document['metadata']['name']}", document


OBJECTS = dict(objects())
RAY = OBJECTS["rayservice.yaml:RayService/rlservo"]
CLUSTER = RAY["spec"]["rayClusterConfig"]
GROUPS = {"head": CLUSTER["headGroupSpec"], "workers": CLUSTER["workerGroupSpecs"][0]}


def check(document: dict[str, Any]) -> None:
    """Check an object of Kubernetes, pod templates of a RayService included; unknown keys are errors."""
    if document["kind"] not in OUR_SCHEMAS:
        kubernetes_validate.validate(document, "1.31", strict=True)
        return
    jsonschema.validate(document, OUR_SCHEMAS[document["kind"]])
    if document["kind"] == "RayService":
        cluster = document["spec"]["rayClusterConfig"]
        for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
            pods = {"apiVersion": "v1", "kind": "PodTemplate", "template": group["template"]}
            kubernetes_validate.validate(pods, "1.31", strict=True)


@pytest.mark.parametrize("name", OBJECTS)
def test_every_object_is_what_kubernetes_takes(name: str) -> None:
    check(OBJECTS[name])


@pytest.mark.parametrize(
    "break_it",
    [
        lambda spec: spec.update(upgradeStrategies={}),
        lambda spec: spec["upgradeStrategy"].update(type="RollingUpdate"),
        lambda spec: spec["rayClusterConfig"]["authOptions"].update(mode="tokens"),
        lambda spec: spec["rayClusterConfig"]["gcsFaultToleranceOptions"].update(redisadress="redis:6379"),
        lambda spec: spec["rayClusterConfig"]["headGroupSpec"]["template"]["spec"].update(runAsNonRoot=True),
        lambda spec: spec["rayClusterConfig"]["workerGroupSpecs"][0]["rayStartParams"].update({"num-cpus": 1}),
        lambda spec: spec["rayClusterConfig"]["workerGroupSpecs"][0]["template"]["spec"]["containers"][0].pop("name"),
    ],
)
def test_a_misspelt_key_or_a_wrong_value_does_not_pass(break_it: Callable[[dict[str, Any]], None]) -> None:
    broken = copy.deepcopy(RAY)
    break_it(broken["spec"])
    with pytest.raises((jsonschema.ValidationError, kubernetes_validate.ValidationError)):
        check(broken)


def test_kustomization_names_every_file_but_the_secrets() -> None:
    (kustomization,) = documents(KUBERAY / "kustomization.yaml")
    files = {file.name for file in KUBERAY.glob("*.yaml") if not file.name.startswith("secrets")}
    assert sorted(kustomization["resources"]) == sorted(files - {"kustomization.yaml"})


@pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`")  # ray 2.60 under pydantic 2.14
@pytest.mark.parametrize("file", [DEPLOY / "serve.yaml", "RayService"])
def test_serve_configuration_is_what_ray_and_the_application_take(file: Path | str) -> None:
    from ray.serve.schema import ServeDeploySchema

    from rlservo.serve_app.engines.ray_serve import BuildArguments

    text = RAY["spec"]["serveConfigV2"] if file == "RayService" else Path(file).read_text()
    configuration = yaml.safe_load(text)
    ServeDeploySchema.model_validate(configuration)
    known = ServeDeploySchema.model_fields
    assert set(configuration) <= set(known)  # Ray drops what it does not know
    (application,) = configuration["applications"]
    arguments = BuildArguments.model_validate(application["args"])
    ServerSettings.model_validate(arguments.settings)
    for deployment in application.get("deployments", []):
        ServedConfig.parse(deployment.get("user_config", {}))


def test_proxies_are_on_every_node_and_replicas_apart() -> None:
    configuration = yaml.safe_load(RAY["spec"]["serveConfigV2"])
    assert configuration["proxy_location"] == "EveryNode"
    (application,) = configuration["applications"]
    workers = GROUPS["workers"]
    assert application["args"]["replicas"] == workers["replicas"]
    assert workers["minReplicas"] <= workers["replicas"] <= workers["maxReplicas"]  # KubeRay keeps it between these
    assert application["deployments"][0]["max_replicas_per_node"] == 1
    assert GROUPS["head"]["rayStartParams"]["num-cpus"] == "0"


def test_replicas_of_a_change_find_room_beside_those_they_replace() -> None:
    (application,) = yaml.safe_load(RAY["spec"]["serveConfigV2"])["applications"]
    (stated,) = application["deployments"]
    replicas, surge = application["args"]["replicas"], stated.get("max_surge_percent", 100)  # as engines/ray_serve.py
    most = replicas + -(-replicas * surge // 100)
    assert most <= GROUPS["workers"]["minReplicas"] * stated["max_replicas_per_node"]


def test_nodes_have_rays_documented_switches_and_settings_of_ours() -> None:
    stated = OBJECTS["cluster-environment.yaml:ConfigMap/rlservo-cluster-environment"]["data"]
    rays = {name: value for name, value in stated.items() if name.startswith("RAY_")}
    assert rays == SWITCHES
    pages = [DEPLOY.parent / page for page in ("README.md", "docs/how-to/ray-and-kubernetes.md", "deploy/serve.yaml")]
    assert all(f" {name}={value}" in page.read_text() for page in pages for name, value in SWITCHES.items())
    own = {name.removeprefix(PREFIX).lower() for name in stated if name.startswith(PREFIX)}
    assert own <= set(ServerSettings.model_fields)
    for group in GROUPS.values():
        (container,) = group["template"]["spec"]["containers"]
        assert {"configMapRef": {"name": "rlservo-cluster-environment"}} in container["envFrom"]
        mounts = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
        volumes = {volume["name"]: volume for volume in group["template"]["spec"]["volumes"]}
        keys = volumes[mounts[str(Path(stated["RLSERVO_API_KEYS_FILE"]).parent)]]
        assert keys["secret"]["secretName"] == "rlservo-keys"


@pytest.mark.parametrize("name", ["head", "workers", "redis"])
def test_pods_run_as_nobody_special_with_requests_and_probes(name: str) -> None:
    redis = OBJECTS["redis.yaml:StatefulSet/rlservo-redis"]["spec"]
    spec = GROUPS.get(name, redis)["template"]["spec"]
    assert spec["securityContext"]["runAsNonRoot"] and spec["securityContext"]["runAsUser"] > 0
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert spec["automountServiceAccountToken"] is False
    for container in spec["containers"]:
        confined = container["securityContext"]
        assert confined["readOnlyRootFilesystem"] and not confined["allowPrivilegeEscalation"]
        assert confined["capabilities"] == {"drop": ["ALL"]}
        assert set(container["resources"]["requests"]) == {"cpu", "memory"}
        assert "memory" in container["resources"]["limits"]
        assert "readinessProbe" in container and "livenessProbe" in container
        assert ":" in container["image"] and not container["image"].endswith(":latest")


def test_every_secret_that_is_used_is_in_the_example_and_the_keys_in_it_can_be_read(tmp_path: Path) -> None:
    examples = {
        document["metadata"]["name"]: document["stringData"] for document in documents(KUBERAY / "secrets.example.yaml")
    }

    def references(value: Any) -> Iterator[tuple[str, str | None]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                if key in ("secretKeyRef", "credentials"):
                    yield inner["name"], inner["key"]
                elif key == "secretRef":
                    yield inner["name"], None
                elif key == "secretName":
                    yield inner, None
                else:
                    yield from references(inner)
        elif isinstance(value, list):
            for inner in value:
                yield from references(inner)

    used = set(references([document for name, document in OBJECTS.items() if "secrets" not in name]))
    assert {name for name, _ in used} == set(examples)
    assert all(key is None or key in examples[name] for name, key in used)
    file = tmp_path / "keys"
    file.write_text(examples["rlservo-keys"]["keys"])
    Keys.from_settings(ServerSettings(api_keys_file=str(file), operator_key=examples["rlservo-operator"]["hash"]))


def test_network_policy_lets_in_clients_operator_and_prometheus_to_ports_that_are_there() -> None:
    policy = OBJECTS["networkpolicy.yaml:NetworkPolicy/rlservo"]["spec"]
    own = policy["podSelector"]["matchLabels"]
    for group in GROUPS.values():
        assert own.items() <= group["template"]["metadata"]["labels"].items()
    (monitor,) = documents(KUBERAY / "podmonitor.yaml")
    selected = monitor["spec"]["selector"]["matchLabels"]
    assert selected.items() <= GROUPS["workers"]["template"]["metadata"]["labels"].items()
    (worker,) = GROUPS["workers"]["template"]["spec"]["containers"]
    ports = {port["name"]: port["containerPort"] for port in worker["ports"]}
    asked = {ports[endpoint["port"]] for endpoint in monitor["spec"]["podMetricsEndpoints"]}
    (metrics,) = (port for rule in policy["ingress"] for port in rule.get("ports", []) if port["port"] == min(asked))
    assert asked == set(range(metrics["port"], metrics["endPort"] + 1))
    open_to_all = [rule for rule in policy["ingress"] if not rule.get("from")]
    assert open_to_all == [] and all(rule.get("ports") for rule in policy["ingress"][1:])


def test_compose_is_well_formed_and_no_linter_finds_a_serious_fault() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    PyCompose.from_yaml(yaml.safe_dump(compose)).validate()  # without the merge keys, which its parser leaves to others
    with pytest.raises(ValueError, match="memlimit"):
        PyCompose.from_yaml("services: {a: {image: 'a:1', memlimit: 1g}}")
    done = subprocess.run(
        [program("compose-lint"), "--format", "json", str(DEPLOY / "compose.yaml")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


def test_compose_publishes_nginx_alone_and_every_service_is_confined_and_watched() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    lasting = {"server", "nginx", "store", "prometheus", "grafana"}
    once = {"store-volume", "bucket", "publish"}
    assert set(compose["services"]) == lasting | once
    assert compose["networks"]["inside"] == {"internal": True}
    owner = compose["services"].pop("store-volume")  # root, for one call of chown
    assert (owner["cap_drop"], owner["cap_add"], owner["network_mode"]) == (["ALL"], ["CHOWN"], "none")
    for name, service in compose["services"].items():
        assert ("ports" in service) == (name == "nginx"), name
        assert (service["networks"] == ["inside"]) == (name != "nginx")
        assert service["read_only"] and service["cap_drop"] == ["ALL"]
        assert ("healthcheck" in service, service["restart"]) == (
            (name in lasting),
            ("no" if name in once else "unless-stopped"),
        )
        assert service["user"].partition(":")[0] not in ("", "0", "root")
        assert service["image"].rpartition(":")[2] not in ("", "latest")
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            assert source in compose["volumes"] or source == "../policies" or (DEPLOY / source).is_file(), source
        assert set(service.get("secrets", [])) <= set(compose["secrets"])


def test_compose_has_a_way_to_the_first_bundle_and_its_page_makes_every_secret(tmp_path: Path) -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    services, ended = compose["services"], {"condition": "service_completed_successfully"}
    assert services["publish"]["depends_on"] == services["server"]["depends_on"] == {"bucket": ended}
    assert services["nginx"]["depends_on"] == ["server"]  # which may wait for its first bundle
    assert "mb --ignore-existing store/policies" in services["bucket"]["command"][0]
    assert services["publish"]["command"][-1] == services["server"]["command"][2] == "s3://policies"
    assert services["publish"]["environment"].items() <= services["server"]["environment"].items()
    (block,) = [each.text for each in blocks(HOW_TO / "compose-and-tls.md") if "deploy/secrets\n" in each.text]
    path = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-euc", block], cwd=tmp_path, env=os.environ | path, check=True, capture_output=True)
    made = tmp_path / "deploy" / "secrets"
    assert made.stat().st_mode & 0o777 == 0o700
    for name, secret in compose["secrets"].items():
        file = made / name
        assert secret["file"] == f"./secrets/{name}" and file.stat().st_mode & 0o777 == 0o444 and file.stat().st_size
    keys = Keys.from_settings(ServerSettings(api_keys_file=str(made / "api_keys")))
    assert [(key.label, key.role.name) for key in keys.keys] == [
        ("cell-7", "act"), ("prometheus", "act"), ("operator", "admin")
    ]  # fmt: skip
    prometheus = keys.find((made / "prometheus_key").read_bytes().strip())
    assert prometheus is not None and prometheus.label == "prometheus"
    s3 = configparser.ConfigParser()
    s3.read(made / "s3_credentials")
    stored = {name: (made / name).read_text().strip() for name in ("store_user", "store_password")}
    assert [*s3["default"].values()] == [stored["store_user"], stored["store_password"]]


def test_grafana_finds_the_dashboard_where_it_looks() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    (provider,) = documents(DEPLOY / "compose" / "grafana-dashboards.yaml")[0]["providers"]
    folder = provider["options"]["path"]
    assert any(volume.split(":")[1].startswith(f"{folder}/") for volume in compose["services"]["grafana"]["volumes"])
    (source,) = documents(DEPLOY / "compose" / "grafana-datasource.yaml")[0]["datasources"]
    assert source["type"] == "prometheus" and source["url"] == "http://prometheus:9090"


def test_dockerfile_passes_hadolint() -> None:
    command = [program("hadolint"), "--failure-threshold", "style", str(DEPLOY / "Dockerfile")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_dockerfile_runs_as_somebody_without_rights_and_installs_pinned_versions() -> None:
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    words = [line.split() for line in lines if line and not line.startswith(("#", " "))]
    stages = [each[1] for each in words if each[0] == "FROM"]
    assert len(stages) == 2 and all(":" in image and not image.endswith(":latest") for image in stages)
    assert [each[1] for each in words if each[0] == "USER"] == ["1000:1000"]
    assert {"HEALTHCHECK", "LABEL", "CMD"} <= {each[0] for each in words}
    assert "ARG EXTRAS=serve,remote" in lines and any('-c constraints.txt ".[${EXTRAS}]"' in line for line in lines)
    constraints = (DEPLOY.parent / "constraints.txt").read_text()
    assert f"ray=={CLUSTER['rayVersion']}\n" in constraints


def test_dashboard_is_in_json_and_its_uid_is_its_own() -> None:
    dashboard = json.loads((DEPLOY / "grafana.json").read_text())
    assert dashboard["uid"] == "rlservo"


@pytest.mark.slow
def test_systemds_unit_is_valid_and_its_command_serves(shipped: Path, tmp_path: Path) -> None:
    """As systemd reads it, with a folder of its own in place of the machine's."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("there is no systemd-analyze here (Debian: apt-get install systemd)")
    unit = tmp_path / "rlservo.service"
    unit.write_text((DEPLOY / "rlservo.service").read_text().replace("/opt/rlservo/bin/rlservo", program("rlservo")))
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    service = configparser.ConfigParser(interpolation=None, strict=False)
    service.read(unit)
    keys = tmp_path / "keys"
    keys.write_text(new_key("operator", admin=True)[1] + "\n")
    name, _, _ = service["Service"]["Environment"].partition("=")
    (port,) = free_ports(1)
    command = service["Service"]["ExecStart"].replace(" policies ", f" {shipped / 'ur5'} ").split()
    with running([*command, "--port", str(port)], port, **{name: str(keys)}) as server:
        assert server.process.stdout is not None
        assert any(line.startswith("ready") for line in server.process.stdout)
