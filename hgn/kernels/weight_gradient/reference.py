"""Reference of hgn.kernels.weight_gradient.kernel, see hgn.kernels.reference."""

from __future__ import annotations

from hgn.kernels.reference import Added, Outputs


def weight_gradient(left, right, jobs, counts, **_) -> Outputs:
    """Each entry of the list by itself. `right` gives, by their offsets, the buffers about the kernel's own."""
    outputs: Outputs = {}
    for number, job in enumerate(jobs.tolist()):
        left_at, right_at, at, counted, left_width, right_width, multiple, bias_at = job
        count = int(counts[counted]) * multiple
        a = left[left_at : left_at + count * left_width].view(count, left_width)
        b = right[right_at].flatten()[: count * right_width].view(count, right_width)
        outputs[f"weight {number}"] = Added(at, a.T @ b)
        if bias_at >= 0:
            outputs[f"bias {number}"] = Added(bias_at, a.sum(0))
    return outputs
