"""Runs and twins in a browser: python -m mosa.viewer"""
