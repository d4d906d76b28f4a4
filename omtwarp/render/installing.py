"""What drawing with OpenGL needs installed, for messages."""

INSTALL_GL = "apt-get install --no-install-recommends libegl1 libgl1"
INSTALL_PYRENDER = "pip install 'omtwarp[preview]'"
