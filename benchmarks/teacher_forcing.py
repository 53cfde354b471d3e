"""Times the likelihood of a training batch with gradients by hand and by autograd, in turn.

    python -m benchmarks.teacher_forcing [--agents 128] [--repeats 9] [--json FILE]

What is compared is the decoder's part of a training step: 25 rollouts an agent along a true
future, forward and backward. CPU seconds of one thread: medians, and the
median of the ratios pair by pair.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import torch
from torch import Tensor

from trajectron_model.config import ModelConfig
from trajectron_model.decoder import Decoder, Start

_ENCODING = 40


def by_autograd(decoder: Decoder, start: Start, future: Tensor) -> Tensor:
    """Log density [R, H], every operation recorded."""
    h, c, velocity = start.hidden, start.cell, start.velocity
    hidden = []
    for t in range(future.shape[1]):
        h, c = decoder.cell(start, velocity, h, c)
        hidden.append(h)
        velocity = future[:, t]
    previous = torch.cat([start.velocity.unsqueeze(1), future[:, :-1]], dim=1)
    return decoder.mixture(torch.stack(hidden, dim=1), previous).log_prob(future)


def seconds(decoder: Decoder, agents: int, *, by_hand: bool) -> float:
    """One loss and its gradients."""
    encoding = torch.randn(agents, _ENCODING, requires_grad=True)
    agent, latent = decoder.every_latent(agents)
    velocity, future = torch.randn(agents, 2), torch.randn(len(agent), 12, 2)
    begin = time.process_time()
    start = decoder.start(decoder.prepare(encoding, velocity), agent, latent)
    found = decoder.log_prob(start, future) if by_hand else by_autograd(decoder, start, future)
    torch.logsumexp(found.sum(dim=1).reshape(agents, -1), dim=1).mean().backward()
    decoder.zero_grad(set_to_none=True)
    return time.process_time() - begin


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agents", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    decoder = Decoder(ModelConfig(), _ENCODING)
    pairs = [
        [seconds(decoder, arguments.agents, by_hand=by_hand) for by_hand in (False, True)]
        for _ in range(arguments.repeats + 1)
    ][1:]
    result = {
        "agents": arguments.agents,
        "autograd_s": statistics.median(pair[0] for pair in pairs),
        "by_hand_s": statistics.median(pair[1] for pair in pairs),
        "ratio": statistics.median(pair[0] / pair[1] for pair in pairs),
        "ratio_of_minima": min(p[0] for p in pairs) / min(p[1] for p in pairs),
    }
    print(json.dumps(result, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
