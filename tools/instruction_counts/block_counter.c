/* The block hook of the emulator: counts the instructions of every executed block of Thumb code. An instruction is a
 * half-word, or two if the first one begins with 11101, 11110 or 11111. */
#include <stdint.h>

typedef struct {
  const uint16_t *code; /* the image, which begins at address 0 */
  uint64_t instructions;
  uint32_t *executions; /* by half-word: instructions executed in blocks that begin here */
} block_counter;

void count_block(void *emulator, uint64_t address, uint32_t size, void *data) {
  block_counter *counter = data;
  uint32_t count = 0;
  (void)emulator;
  for (uint64_t at = address / 2, end = (address + size) / 2; at < end; ++count) {
    at += (counter->code[at] >> 11) >= 0x1D ? 2 : 1;
  }
  counter->instructions += count;
  counter->executions[address / 2] += count;
}
