"""Ids of the environments, and their registration with Gymnasium. MuJoCo is imported when an environment is made."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

from rlservo.bundle.environment_id import NAMESPACE

ENTRY_POINTS = {
    "EndEffectorPositioningURSim-v0": "rlservo.envs.ur.end_effector_positioning:EndEffectorPositioningURSim",
    "EndEffectorPositioningURRob-v0": "rlservo.envs.ur.end_effector_positioning:EndEffectorPositioningURRob",
    "EmptyEnvironmentURSim-v0": "rlservo.envs.ur.empty_environment:EmptyEnvironmentURSim",
    "BasicAvoidanceURSim-v0": "rlservo.envs.ur.basic_avoidance:BasicAvoidanceURSim",
    "IsaacReachURSim-v0": "rlservo.envs.ur.isaac_reach:IsaacReachURSim",
    "IsaacDeployReachURSim-v0": "rlservo.envs.ur.isaac_deploy_reach:IsaacDeployReachURSim",
    "IsaacDeployReachURRob-v0": "rlservo.envs.ur.isaac_deploy_reach:IsaacDeployReachURRob",
    "EmptyEnvironmentPandaSim-v0": "rlservo.envs.panda.arm_env:EmptyEnvironmentPandaSim",
    "EndEffectorPositioningPandaSim-v0": "rlservo.envs.panda.end_effector_positioning:EndEffectorPositioningPandaSim",
    "NoObstacleNavigationMir100Sim-v0": "rlservo.envs.mir100.no_obstacle_navigation:NoObstacleNavigationMir100Sim",
    "SparseFixNavigationMir100Sim-v0": "rlservo.envs.mir100.sparse_fix_navigation:SparseFixNavigationMir100Sim",
    "ObstacleAvoidanceMir100Sim-v0": "rlservo.envs.mir100.obstacle_avoidance:ObstacleAvoidanceMir100Sim",
    "NoObstacleNavigationMir100Rob-v0": "rlservo.envs.mir100.real:NoObstacleNavigationMir100Rob",
    "ObstacleAvoidanceMir100Rob-v0": "rlservo.envs.mir100.real:ObstacleAvoidanceMir100Rob",
    "Randomized-v0": "rlservo.envs.randomization:make_randomized",
}


def register_envs() -> None:
    """Register every environment as `rlservo/<id>`; harmless when repeated.

    The episode limit is the environment's own, so no `max_episode_steps` is given here.
    """
    for name, entry_point in ENTRY_POINTS.items():
        if f"{NAMESPACE}/{name}" not in registry:
            register(id=f"{NAMESPACE}/{name}", entry_point=entry_point)
