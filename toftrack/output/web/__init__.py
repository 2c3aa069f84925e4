"""Estimates for web pages: a websocket, and two pages that show what it is good for."""
