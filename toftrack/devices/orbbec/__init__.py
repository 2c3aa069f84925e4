"""Orbbec's depth cameras (Femto, Gemini, Astra), through the vendor's SDK."""
