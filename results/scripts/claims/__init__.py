"""The claims of Niakh, Drouet, Ehrlacher and Ern (2022), each compared with measured numbers."""
