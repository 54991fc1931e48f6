/* The firmware of a board without an operating system. */
#include "executive/loop.h"

static executive state;

int main(void) {
  executive_loop(&state);
  return 0;
}
