"""The trained model: base, LoRA layers, precision, quantization, batches."""
