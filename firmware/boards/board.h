/* The mps2 boards that QEMU emulates: an386 (Cortex-M4F), an500 (M7), an505 (M33). The build sets the addresses. */
#ifndef FIRMWARE_BOARD_H
#define FIRMWARE_BOARD_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

/* given by the build: UART_BASE, UART_RX_IRQ, DRIVE_OUTPUT_ADDRESS, CLOCK_HZ, WATCHDOG_BASE, MAILBOX_BASE */

void board_systick_handler(void);
void board_uart_handler(void);
void board_drive_off(void);

/* ends the emulation with an exit code (semihosting SYS_EXIT_EXTENDED) */
static inline void __attribute__((noreturn)) board_exit(int code) {
  const volatile uint32_t block[2] = {0x20026u, (uint32_t)code};
  register uint32_t operation __asm__("r0") = 0x20u;
  register const volatile uint32_t *argument __asm__("r1") = block;
  __asm__ volatile("bkpt 0xab" ::"r"(operation), "r"(argument) : "memory");
  for (;;) {}
}

#endif
