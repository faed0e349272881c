"""The bare loop: a UR5 simulator driven by a served policy.

    rlservo export examples/checkpoints/ur_positioning --out policies --name ur5
    rlservo serve policies
    python examples/ur5_client.py --url http://127.0.0.1:8000 --policy ur5

Everything the policy needs (filter, network, scaling) is in the served graph, so nothing happens here between the
environment's observation and its action. `rlservo rollout` is this loop with statistics.
"""

from __future__ import annotations

import argparse

import gymnasium as gym

import rlservo


def main() -> None:
    parser = argparse.ArgumentParser(description="Drive a UR5 simulator with a served policy.")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--policy", default="ur5")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--show", action="store_true", help="open MuJoCo's viewer (needs a display)")
    args = parser.parse_args()

    env = gym.make("rlservo.envs:rlservo/EndEffectorPositioningURSim-v0", render_mode="human" if args.show else None)
    with rlservo.PolicyClient(args.url, args.policy) as policy:
        for episode in range(args.episodes):
            obs, info = env.reset(seed=episode)
            policy.reset()
            total, steps, ended = 0.0, 0, False
            while not ended:
                obs, reward, terminated, truncated, info = env.step(policy.act(obs))
                total, steps, ended = total + float(reward), steps + 1, terminated or truncated
            print(f"episode {episode}: {info['final_status']} after {steps / 10:.1f} s, return {total:.2f}")
    env.close()


if __name__ == "__main__":
    try:
        main()
    except rlservo.errors.RlservoError as error:
        raise SystemExit(f"error: {error}") from None
