"""The constraints of a simulated frame: they need no training, and hold whatever the parameters of the network are.

| setting of `step:` | stage | effect |
|---|---|---|
| `rest_threshold` | after the network | particles in contact that deform slowly stop |
| `wall_clearance` | after the integration | no particle comes nearer to the domain's planes |
| `obstacle_clearance` | after the walls | no particle passes an obstacle's triangle |

`hgn.step_config.StepConfig` holds the settings: `ParticleNetwork.step` of a network, section `step` of a weights file.
They act in this order, in one file of each backend:

| backend | file |
|---|---|
| torch, cpu, exported steps, gradients | `hgn/step/reference.py` |
| triton | `hgn/kernels/step/kernel.py`, launched by `hgn/kernels/step/op.py` |

Losses compare the network's output before any of them. Pushforward simulations are constrained by obstacles only.
"""
