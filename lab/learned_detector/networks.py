"""The networks of the learned detector. They need torch, which only training does; the program runs exported weights.

Output of each, per cell of STRIDE pixels: logit of "a centre is here", offset of the centre from the cell's centre
(cells), and log of the diameter (px).
"""

from __future__ import annotations

from typing import Any

STRIDE = 4
SMALL, PAPER = "small", "zhou2020"
NETWORKS = (SMALL, PAPER)


def make_network(name: str) -> Any:
    """A torch.nn.Module: grey pictures (n, 1, h, w) of 0 to 1 -> (n, 4, h / STRIDE, w / STRIDE).

    Raises:
        ImportError: torch is not installed.
        ValueError: there is no network of that name.
    """
    if name == SMALL:
        return _small()
    if name == PAPER:
        return _zhou2020()
    raise ValueError(f"expected one of {', '.join(NETWORKS)}, got {name!r}")


def _layer(before: int, after: int, stride: int = 1) -> Any:
    from torch import nn

    return nn.Sequential(nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU())


def _small() -> Any:
    """Some 177,000 parameters: layers at 1/2 and 1/4 of the picture; five at 1/8, whose output is enlarged and added.

    A cell sees 47 px on each side. The sides of the picture are multiples of 8. Source: ours, after Ronneberger
    (2015), U-Net.
    """
    from torch import nn
    from torch.nn import functional

    class Small(nn.Module):  # type: ignore[misc]  # no types without torch, an extra
        def __init__(self) -> None:
            super().__init__()
            self.fine = nn.Sequential(_layer(1, 12, 2), _layer(12, 24, 2), _layer(24, 24))
            self.deep = nn.Sequential(_layer(24, 64, 2), *[_layer(64, 64) for _ in range(4)])
            self.lateral = nn.Conv2d(64, 24, 1)
            self.head = nn.Sequential(_layer(24, 24), nn.Conv2d(24, 4, 1))
            # Few cells hold a centre: start from a low probability.
            nn.init.constant_(self.head[-1].bias, 0.0)
            self.head[-1].bias.data[0] = -5.0

        def forward(self, x: Any) -> Any:
            fine = self.fine(x)
            coarse = functional.interpolate(self.lateral(self.deep(fine)), scale_factor=2, mode="nearest")
            return self.head(functional.relu(fine + coarse))

    return Small()


def _zhou2020() -> Any:
    """The layout of Zhou (2020), table 1: residual blocks of 1x1 and 3x3 layers, 1, 2, 8, 8 and 4 of them.

    The paper predicts boxes at three scales; here the features of the coarser scales are enlarged and added to those
    of STRIDE, and the head is the one of the small network, so that both are trained and used in the same way.
    """
    from torch import nn
    from torch.nn import functional

    def layer(before: int, after: int, size: int, stride: int = 1) -> Any:
        return nn.Sequential(
            nn.Conv2d(before, after, size, stride, size // 2, bias=False), nn.BatchNorm2d(after), nn.LeakyReLU(0.1)
        )

    class Residual(nn.Module):  # type: ignore[misc]  # no types without torch, an extra
        def __init__(self, channels: int) -> None:
            super().__init__()
            self.body = nn.Sequential(layer(channels, channels // 2, 1), layer(channels // 2, channels, 3))

        def forward(self, x: Any) -> Any:
            return x + self.body(x)

    class Zhou2020(nn.Module):  # type: ignore[misc]  # no types without torch, an extra
        def __init__(self) -> None:
            super().__init__()
            self.first = layer(1, 16, 3)
            self.stages, self.lateral, channels = nn.ModuleList(), nn.ModuleList(), 16
            for blocks, out in ((1, 32), (2, 64), (8, 128), (8, 256), (4, 512)):
                residuals = [Residual(out) for _ in range(blocks)]
                self.stages.append(nn.Sequential(layer(channels, out, 3, 2), *residuals))
                channels = out
                if out >= 64:
                    self.lateral.append(nn.Conv2d(out, 64, 1))
            self.head = nn.Sequential(layer(64, 64, 3), nn.Conv2d(64, 4, 1))

        def forward(self, x: Any) -> Any:
            x, scales = self.first(x), []
            for number, stage in enumerate(self.stages):
                x = stage(x)
                if number >= 1:
                    scales.append(self.lateral[number - 1](x))
            out = scales.pop()
            while scales:
                finer = scales.pop()
                out = finer + functional.interpolate(out, size=finer.shape[-2:], mode="nearest")
            return self.head(out)

    return Zhou2020()
