"""Arms whose tool a MuJoCo mocap body drags through a weld: metaworld and the Fetch of gymnasium-robotics."""
