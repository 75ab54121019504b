"""Checking data sets, down to playing episodes again, and making damaged ones whole."""

from openvima.data.verification.checks import verify
from openvima.data.verification.findings import Problem, Verification, VerifyConfig
from openvima.data.verification.repairing import Repair, repair

__all__ = ["Problem", "Repair", "Verification", "VerifyConfig", "repair", "verify"]
