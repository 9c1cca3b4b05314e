"""Contrast maximization as modules for learning: warps, images of warped events, losses, and the whole estimator as a layer."""

from torchcmax.nn.compensate import Compensate
from torchcmax.nn.flow import FlowContrastLoss
from torchcmax.nn.image import ImageOfWarpedEvents, Warp
from torchcmax.nn.loss import ContrastLoss

__all__ = ["Compensate", "ContrastLoss", "FlowContrastLoss", "ImageOfWarpedEvents", "Warp"]
