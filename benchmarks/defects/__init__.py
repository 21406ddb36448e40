"""Mistakes planted on purpose: do the tests notice?"""
