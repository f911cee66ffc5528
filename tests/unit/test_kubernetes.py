"""The Kubernetes manifests are valid, consistent and restricted, and their settings are known."""

import re
from typing import Any

import kubernetes_validate
import pytest
import yaml

from kouxing.services.service_kinds import CONFIG_TYPES, KINDS
from kouxing.shared.settings.config import BindAddress, Settings, bound_keys
from tests.system import ROOT

FOLDER = ROOT / "deploy" / "kubernetes"
KUSTOMIZATION = yaml.safe_load((FOLDER / "kustomization.yaml").read_text("utf-8"))
OBJECTS: dict[tuple[str, str], Any] = {
    (item["kind"], item["metadata"]["name"]): item
    for name in KUSTOMIZATION["resources"]
    for item in yaml.safe_load_all((FOLDER / name).read_text("utf-8"))
}
WORKLOADS = {
    name: item for (kind, name), item in OBJECTS.items() if kind in ("Deployment", "StatefulSet")
}
SECRETS = {
    item["name"]: {file.rpartition("/")[2] for file in item["files"]}
    for item in KUSTOMIZATION["secretGenerator"]
}
per_service = pytest.mark.parametrize("name", WORKLOADS)


def container(name: str) -> Any:
    (single_fap,) = WORKLOADS[name]["spec"]["template"]["spec"]["containers"]
    return single_fap


def ports(name: str) -> dict[str, int]:
    return {port["name"]: port["containerPort"] for port in container(name)["ports"]}


def test_the_objects_are_valid_and_all_services_except_the_driver_run() -> None:
    for item in OBJECTS.values():
        kubernetes_validate.validate(item, kubernetes_validate.latest_version(), strict=True)
    assert WORKLOADS.keys() == KINDS.keys() - {"driver"}
    files = {path.name for path in FOLDER.glob("*.yaml")}
    assert files == {*KUSTOMIZATION["resources"], "kustomization.yaml", "prometheus-adapter.yaml"}


@per_service
def test_the_settings_of_a_service_are_valid(name: str) -> None:
    variables = dict(OBJECTS["ConfigMap", "kouxing"]["data"])
    variables |= {item["name"]: item.get("value", "") for item in container(name)["env"]}
    config = Settings(CONFIG_TYPES, environment=variables).load(CONFIG_TYPES[name])
    assert container(name)["args"] == [name]
    assert not config.insecure
    assert config.metrics == f"0.0.0.0:{ports(name)['metrics']}"
    for key, bound in bound_keys(type(config)).items():
        value = getattr(config, "bound_control" if key == "control" else key)
        if bound is BindAddress.ENDPOINT:
            port = "commands" if key == "control" else key.replace("_", "-")
            assert value == f"tcp://0.0.0.0:{ports(name)[port]}"
        elif bound is BindAddress.PORT:
            assert value == ports(name)["page"]


@per_service
def test_a_service_has_no_privileges_and_only_its_own_key(name: str) -> None:
    pod = WORKLOADS[name]["spec"]["template"]["spec"]
    assert pod["securityContext"]["runAsNonRoot"]
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert not pod["automountServiceAccountToken"]
    assert not pod["enableServiceLinks"], "its variables could look like settings"
    assert container(name)["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    user = f"USER {pod['securityContext']['runAsUser']}:{pod['securityContext']['runAsGroup']}\n"
    assert user in (ROOT / "deploy" / "Dockerfile").read_text("utf-8")
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    mounts = {mount["name"]: mount["mountPath"] for mount in container(name)["volumeMounts"]}
    assert mounts.keys() == volumes.keys()
    assert mounts["keys"] == OBJECTS["ConfigMap", "kouxing"]["data"]["CREDENTIALS_DIRECTORY"]
    assert volumes["keys"]["secret"]["defaultMode"] == 0o440
    given = SECRETS[volumes["keys"]["secret"]["secretName"]]
    assert {file for file in given if file.endswith(".key")} == {f"{name}.key"}
    assert ("allowed" in given) == (name == "control")


@per_service
def test_labels_and_ports_match(name: str) -> None:
    labels = WORKLOADS[name]["spec"]["template"]["metadata"]["labels"]
    assert WORKLOADS[name]["spec"]["selector"]["matchLabels"].items() <= labels.items()
    service = OBJECTS["Service", name]["spec"]
    assert service["selector"].items() <= labels.items()
    names = ports(name)
    assert {port["name"] for port in service["ports"]} == names.keys() - {"metrics"}
    policy = OBJECTS["NetworkPolicy", name]["spec"]
    assert policy["podSelector"]["matchLabels"].items() <= labels.items()
    opened = {port["port"] for rule in policy["ingress"] for port in rule["ports"]}
    assert opened == names.keys()


@pytest.mark.parametrize("name", ["recognizer", "synthesizer"])
def test_workers_are_scaled_by_a_metric_that_they_export(name: str) -> None:
    assert OBJECTS["Service", name]["spec"]["clusterIP"] == "None"
    assert WORKLOADS[name]["spec"]["serviceName"] == name
    scaler = OBJECTS["HorizontalPodAutoscaler", name]["spec"]
    target = WORKLOADS[scaler["scaleTargetRef"]["name"]]
    assert target["kind"] == scaler["scaleTargetRef"]["kind"]
    assert "replicas" not in target["spec"], "the autoscaler's"
    (metric,) = (item["pods"]["metric"]["name"] for item in scaler["metrics"])
    assert f"| `{metric}` |" in (ROOT / "docs" / "metrics.md").read_text("utf-8")
    adapter = yaml.safe_load((FOLDER / "prometheus-adapter.yaml").read_text("utf-8"))
    (rule,) = adapter["rules"]["custom"]
    assert rule["name"]["as"] == metric
    assert re.match(r"\w+", rule["seriesQuery"])[0] == metric  # type: ignore[index]
