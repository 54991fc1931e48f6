"""The camera image in the messages to a chat server."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dualbrain.planner.camera_image import CameraImage
from dualbrain.planner.prompt import image_note
from dualbrain.planner.prompt.full_prompt import ChatMessage

IMAGE_STATUSES = (400, 415, 422, 500)
"""HTTP statuses with which servers refuse an image; llama.cpp answers 500, others 400."""
IMAGE_REMEDY = (
    "The model of this server may take no image: leave out the image, or serve a vision-language model "
    "(llama.cpp: with --mmproj)."
)


def announce_image(messages: Sequence[ChatMessage]) -> list[ChatMessage]:
    """The messages, the last of which announces an image."""
    *first, last = messages
    return [*first, {"role": last["role"], "content": f"{image_note.IMAGE_NOTE}\n{last['content']}"}]


def attach_image(messages: Sequence[ChatMessage], image: CameraImage) -> list[dict[str, Any]]:
    """The messages with `image` in the last one, in the parts of the OpenAI chat API (also vLLM, llama.cpp)."""
    *first, last = messages
    parts = [
        {"type": "text", "text": last["content"]},
        {"type": "image_url", "image_url": {"url": image.data_url}},
    ]
    return [*(dict(one) for one in first), {"role": last["role"], "content": parts}]


def attach_image_to_message(messages: Sequence[ChatMessage], image: CameraImage) -> list[dict[str, Any]]:
    """The messages with `image` beside the text of the last one, as in the native API of Ollama."""
    *first, last = messages
    return [*(dict(one) for one in first), {**last, "images": [image.base64]}]
