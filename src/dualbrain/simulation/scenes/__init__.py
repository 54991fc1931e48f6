"""Scene specification, scene files and their construction in MuJoCo."""
