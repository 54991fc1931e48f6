/* Start-up code of a Cortex-M with an FPU: vectors, memory, and a report of faults. */
#include <stdint.h>

#include "boards/board.h"

extern uint32_t stack_top, data_source, data_begin, data_end, bss_begin, bss_end;
int main(void);

/* a fault switches the drive off and ends the program; an independent watchdog would restart the board */
static void fault_handler(void) {
  board_drive_off();
  board_exit(99);
}

__attribute__((naked, used)) void reset_handler(void) {
  __asm__ volatile("ldr r0, =stack_top\n msr msp, r0\n bl start\n");
}

__attribute__((used, noreturn)) void start(void) {
  REGISTER(0xE000ED88u) |= 0xFu << 20; /* CPACR: enable the FPU */
  __asm__ volatile("dsb\n isb");
  const uint32_t *from = &data_source;
  for (uint32_t *to = &data_begin; to < &data_end; ++to) { *to = *from++; }
  for (uint32_t *to = &bss_begin; to < &bss_end; ++to) { *to = 0; }
  board_exit(main());
}

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const handler vectors[16 + 64] = {
    (handler)&stack_top,
    reset_handler,
    fault_handler, fault_handler, fault_handler, fault_handler, fault_handler, fault_handler,
    0, 0, 0,
    fault_handler, fault_handler, 0, fault_handler,
    board_systick_handler,
    [16 + UART_RX_IRQ] = board_uart_handler,
};
