"""The constraints of a simulated frame. They need no training, and hold for any parameters of the network.

| setting of `step:`, in the order of the stages | effect |
|---|---|
| `rest_threshold`, after the network | particles in contact that deform slowly stop |
| `wall_clearance`, after the integration | no particle comes nearer to the domain's planes |
| `obstacle_clearance`, after the walls | no particle passes an obstacle's triangle |

Losses compare the network's output before any of them. Pushforward simulations are constrained by obstacles only.
docs/concepts/constraints.md describes each one and lists the files that implement it on each backend.
"""
