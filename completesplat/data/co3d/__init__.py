"""CO3D v2 (Reizenstein et al., ICCV 2021)."""
