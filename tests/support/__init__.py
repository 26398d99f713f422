"""Helpers of the tests: small scenes, independent references, runs on several ranks."""
