"""Tasks of UR arms, the MiR100 and the Panda with robo-gym's contract. Importing it registers them with Gymnasium.

`gym.make("rlservo.envs:rlservo/EndEffectorPositioningURSim-v0")` imports it by itself, in any process, RLlib's workers
included; after `import rlservo.envs` the id alone does.
"""

from rlservo.envs.registration import register_envs

register_envs()
