"""Scoring policies."""
