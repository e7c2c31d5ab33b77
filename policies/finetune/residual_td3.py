"""TD3 on a residual: Stable-Baselines3's, with critics that see more than the actor.

What differs from its TD3: actor and critics read their own keys of the observation, and critics
where an action leads in place of the action (docs/experiments/foresight.md); the critics are an
ensemble with layer norm of which two, drawn anew for each update, make the target (RLPD: Ball et
al., 2023, https://arxiv.org/abs/2302.02948); the actor stands still while they warm up; it is
held to the base by a penalty against the normalised value, as in TD3+BC (Fujimoto and Gu, 2021,
https://arxiv.org/abs/2106.06860); its target follows more slowly than theirs, because it is what
plays in the end: an average over many updates; and updates are made while the environments play.
"""

from collections.abc import Iterable
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import Actor, MultiInputPolicy
from torch import Tensor, nn

from hvs_suite.policies.finetune.outlook import OUTLOOK_SIZE, Outlook
from hvs_suite.policies.finetune.stage import FEATURES, PRIVILEGED
from hvs_suite.policies.network.network import make_residual, normed_layers

N_TARGET_CRITICS = 2
WARM_UP_UPDATES = 4
"""While the critics learn alone, this many times as many updates: what a scene is worth in the end
has to come all the way to its beginning before the actor can trust them."""


class Keys(BaseFeaturesExtractor):
    """Some keys of the observation, joined.

    Args:
        observation_space: Vectors by name.
        keys: Which.
    """

    def __init__(self, observation_space: spaces.Dict, keys: tuple[str, ...]) -> None:
        super().__init__(
            observation_space, sum((observation_space[key].shape or (0,))[0] for key in keys)
        )
        self._keys = keys

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Join them.

        Args:
            observations: (B, n) by name.
        """
        return torch.cat([observations[key] for key in self._keys], dim=1)


class ForesightedCritic(ContinuousCritic):
    """Critics that judge an action by where it leads, and by nothing else.

    Attributes:
        outlook: Reckons that.
    """

    outlook: Outlook

    def forward(self, obs: Any, actions: Tensor) -> tuple[Tensor, ...]:
        """Values of all critics, (B, 1) each; SB3's interface."""
        return self.values(obs, actions, range(len(self.q_networks)))

    def values(self, obs: Any, actions: Tensor, chosen: Iterable[int]) -> tuple[Tensor, ...]:
        """Values of some of the critics.

        Args:
            obs: Vectors by name, (B, n).
            actions: Shares of the bound, (B, 7).
            chosen: Which critics.

        Returns:
            (B, 1) each.
        """
        ahead = self.outlook(obs[FEATURES], obs[PRIVILEGED], actions)
        inputs = torch.cat([obs[FEATURES], obs[PRIVILEGED], ahead], dim=1)
        return tuple(self.q_networks[index](inputs) for index in chosen)


class ResidualPolicy(MultiInputPolicy):
    """Actor on the features alone, critics on features, privileged state and action.

    Args:
        outlook: What critics read of an action.
        arguments: Of SB3's policy.
    """

    def __init__(self, *arguments: Any, outlook: Outlook, **named: Any) -> None:
        self.outlook = outlook
        super().__init__(*arguments, **named)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """An actor that says nothing at first; SB3's interface."""
        del features_extractor
        keys = Keys(self._dict_space(), (FEATURES,))
        actor = Actor(**{**self.actor_kwargs, **_extracted(keys)})
        actor.mu = make_residual(keys.features_dim, actor.net_arch[0])
        return actor.to(self.device)

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        """An ensemble of critics; SB3's interface."""
        del features_extractor
        keys = Keys(self._dict_space(), (FEATURES, PRIVILEGED))
        critic = ForesightedCritic(**{**self.critic_kwargs, **_extracted(keys)})
        critic.outlook = self.outlook
        n_inputs, [hidden, *_] = keys.features_dim + OUTLOOK_SIZE, self.actor.net_arch
        critic.q_networks = [
            nn.Sequential(*normed_layers(n_inputs, hidden), nn.Linear(hidden, 1))
            for _ in critic.q_networks
        ]
        for index, network in enumerate(critic.q_networks):
            critic.add_module(f"qf{index}", network)
        return critic.to(self.device)

    def _dict_space(self) -> spaces.Dict:
        assert isinstance(self.observation_space, spaces.Dict)
        return self.observation_space


class ResidualTD3(TD3):
    """TD3 as this module's head says.

    Attributes:
        actor_rate: Learning rate of the actor; that of SB3 is the critics'.
        actor_tau: Share of the actor that goes into its target; that of SB3 is the critics'.
        updates: Updates while `train_freq` steps are played, spread over them.
        warm_up_steps: Environment steps in which the critics learn alone.
        penalty: Weight of the squared action against the normalised value.
        bound: The most that an action of 1 adds to the base; noted here for who folds it in.
    """

    actor_rate: float
    actor_tau: float
    updates: int
    warm_up_steps: int
    penalty: float
    bound: float

    def learn_overlapped(self) -> None:
        """The updates that fall to a step of the environments, made while these play it."""
        memory, steps = self.replay_buffer, self.train_freq
        assert memory is not None
        assert isinstance(steps, TrainFreq)
        begun = self.num_timesteps // self.n_envs % steps.frequency
        due, done = (self.updates * part // steps.frequency for part in (begun + 1, begun))
        if due > done and memory.size():
            self.train(due - done, self.batch_size)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Update critics, and actor once they have warmed up; SB3's interface."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.critic.optimizer)
        for group in self.actor.optimizer.param_groups:
            group["lr"] = self.actor_rate
        assert self.replay_buffer is not None
        assert isinstance(self.critic_target, ForesightedCritic)
        frees_actor = self.num_timesteps >= self.warm_up_steps
        for _ in range(gradient_steps if frees_actor else WARM_UP_UPDATES * gradient_steps):
            self._n_updates += 1
            data: Any = self.replay_buffer.sample(batch_size)
            with torch.no_grad():
                noise = torch.randn_like(data.actions) * self.target_policy_noise
                noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
                after = (self.actor_target(data.next_observations) + noise).clamp(-1.0, 1.0)
                chosen = torch.randperm(len(self.critic_target.q_networks))[:N_TARGET_CRITICS]
                judges = self.critic_target.values(data.next_observations, after, chosen.tolist())
                worth = torch.cat(judges, dim=1).amin(dim=1, keepdim=True)
                target = data.rewards + (1.0 - data.dones) * self.gamma * worth
            estimates = torch.cat(self.critic(data.observations, data.actions), dim=1)
            loss = F.mse_loss(estimates, target.expand_as(estimates)) * estimates.shape[1]
            self.critic.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.critic.optimizer.step()
            self.logger.record_mean("train/critic_loss", loss.item())
            self.logger.record_mean("train/value", estimates.mean().item())
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            if frees_actor and self._n_updates % self.policy_delay == 0:
                action = self.actor(data.observations)
                worth = torch.cat(self.critic(data.observations, action), dim=1).mean(dim=1)
                scale = 1.0 / worth.abs().mean().detach().clamp(min=1e-3)
                size = (action**2).mean()
                loss = self.penalty * size - scale * worth.mean()
                self.actor.optimizer.zero_grad()
                loss.backward()
                self.actor.optimizer.step()
                polyak_update(
                    self.actor.parameters(), self.actor_target.parameters(), self.actor_tau
                )
                self.logger.record_mean("train/actor_loss", loss.item())
                self.logger.record_mean("train/residual", size.item() ** 0.5)


def _extracted(keys: Keys) -> dict[str, Any]:
    return {"features_extractor": keys, "features_dim": keys.features_dim}
