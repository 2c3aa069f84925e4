"""Runs in formats that other programs open."""
