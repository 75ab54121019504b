"""Verifying and repairing data sets."""

from openvima.data.verification.checks import verify
from openvima.data.verification.findings import Problem, Verification, VerifyConfig
from openvima.data.verification.repairing import Repair, repair

__all__ = ["Problem", "Repair", "Verification", "VerifyConfig", "repair", "verify"]
