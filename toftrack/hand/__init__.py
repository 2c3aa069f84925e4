"""The hand model: skeleton (kinematics), shape (sizes) and surface (ellipsoids)."""
