/* Hardware layer of the emulated boards: a serial line, or a mailbox in shared memory in its place. */
#include "boards/board.h"
#include "port/hal.h"

#define WATCHDOG_MS 250u /* longest pass of the main loop */

void clock_start(void);
static void watchdog_start(void);

#define DRIVE_OUTPUT REGISTER(DRIVE_OUTPUT_ADDRESS) /* the LEDs, in place of the enable input of a drive */

#ifdef LINK_MAILBOX

/* two rings of bytes; each index is written by one side only */
typedef struct {
  volatile uint32_t magic, to_target_head, to_target_tail, to_host_head, to_host_tail, drive, estop, seed;
} mailbox;

#define MAILBOX ((mailbox *)MAILBOX_BASE)
#define RING_SIZE 0x4000u
#define TO_TARGET ((volatile uint8_t *)(MAILBOX_BASE + 0x1000u))
#define TO_HOST ((volatile uint8_t *)(MAILBOX_BASE + 0x1000u + RING_SIZE))
#define MAILBOX_MAGIC 0x64626B31u

static void barrier(void) { __asm__ volatile("dmb" ::: "memory"); }

void hal_init(void) {
  clock_start();
  MAILBOX->drive = 0;
  MAILBOX->to_target_tail = MAILBOX->to_host_head = 0;
  barrier();
  MAILBOX->magic = MAILBOX_MAGIC;
  watchdog_start();
}

int hal_rx(void) {
  const uint32_t tail = MAILBOX->to_target_tail;
  if (tail == MAILBOX->to_target_head) { return -1; }
  barrier();
  const int byte = TO_TARGET[tail % RING_SIZE];
  barrier();
  MAILBOX->to_target_tail = tail + 1u;
  return byte;
}

/* bytes for which the ring has no room are lost: a host that does not read must not stop the target */
void hal_tx(const uint8_t *bytes, uint32_t size) {
  uint32_t head = MAILBOX->to_host_head;
  for (uint32_t i = 0; i < size && head - MAILBOX->to_host_tail < RING_SIZE; ++i) {
    TO_HOST[head % RING_SIZE] = bytes[i];
    ++head;
  }
  barrier();
  MAILBOX->to_host_head = head;
}

void hal_drive_enable(int on) { MAILBOX->drive = (uint32_t)on; }

int hal_estop_in(void) { return MAILBOX->estop != 0u; }

uint64_t hal_nonce(void) { return ((uint64_t)MAILBOX->seed << 32) ^ hal_now(); }

void hal_wait(void) {}

void board_uart_handler(void) {}

void board_drive_off(void) { MAILBOX->drive = 0; }

#else

#define UART_DATA REGISTER(UART_BASE + 0x00u)
#define UART_STATE REGISTER(UART_BASE + 0x04u) /* bit 0: transmitter full, bit 1: receiver full */
#define UART_CONTROL REGISTER(UART_BASE + 0x08u)
#define UART_INTERRUPT REGISTER(UART_BASE + 0x0Cu)
#define UART_DIVIDER REGISTER(UART_BASE + 0x10u)
#ifdef PROFILE_SMALL
#define RING_SIZE 2048u /* of two: more than the longest frame */
#else
#define RING_SIZE 4096u
#endif

static volatile uint8_t ring[RING_SIZE];
static volatile uint32_t ring_head, ring_tail;

void board_uart_handler(void) {
  UART_INTERRUPT = 2u;
  while (UART_STATE & 2u) {
    const uint8_t byte = (uint8_t)UART_DATA;
    if (ring_head - ring_tail < RING_SIZE) { ring[ring_head++ % RING_SIZE] = byte; }
  }
}

void hal_init(void) {
  clock_start();
  hal_drive_enable(0);
  UART_DIVIDER = 16u;
  UART_CONTROL = 1u | 2u | 8u; /* transmitter, receiver, receive interrupt */
  REGISTER(0xE000E100u + 4u * (UART_RX_IRQ / 32u)) = 1u << (UART_RX_IRQ % 32u);
  watchdog_start();
}

int hal_rx(void) { return ring_tail == ring_head ? -1 : ring[ring_tail++ % RING_SIZE]; }

void hal_tx(const uint8_t *bytes, uint32_t size) {
  for (uint32_t i = 0; i < size; ++i) {
    while (UART_STATE & 1u) {}
    UART_DATA = bytes[i];
  }
}

void hal_drive_enable(int on) { DRIVE_OUTPUT = (uint32_t)on; }

int hal_estop_in(void) { return 0; }

uint64_t hal_nonce(void) { return hal_now(); }

void hal_wait(void) { __asm__ volatile("wfi"); }

void board_drive_off(void) { DRIVE_OUTPUT = 0; }

#endif

/* The watchdog of the boards (CMSDK APB): an interrupt that cannot be masked ends in the handler of faults, which
 * switches the drive off. It has no window of its own; the window is tested by the clock of the firmware, because after a
 * pause of the emulator SysTick and the counter of the watchdog differ. In lockstep with a simulation the watchdog stays
 * off, because there the time passes with the messages. */
#define WATCHDOG_LOAD REGISTER(WATCHDOG_BASE + 0x000u)
#define WATCHDOG_CONTROL REGISTER(WATCHDOG_BASE + 0x008u) /* bit 0: counter and interrupt */
#define WATCHDOG_RELOAD REGISTER(WATCHDOG_BASE + 0x00Cu)
#define WATCHDOG_LOCK REGISTER(WATCHDOG_BASE + 0xC00u)

static void watchdog_start(void) {
#ifndef LOCKSTEP
  WATCHDOG_LOCK = 0x1ACCE551u;
  WATCHDOG_LOAD = CLOCK_HZ / 1000u * WATCHDOG_MS;
  WATCHDOG_CONTROL = 1u;
  WATCHDOG_LOCK = 0;
#endif
}

void hal_watchdog(void) {
  static uint64_t fed_us; /* 0: not fed yet */
  const uint64_t now_us = hal_now();
  if (fed_us != 0u && now_us - fed_us < HAL_WATCHDOG_EARLIEST_US) {
    board_drive_off();
    board_exit(99); /* as a fault of the processor */
  }
  fed_us = now_us;
  WATCHDOG_LOCK = 0x1ACCE551u;
  WATCHDOG_RELOAD = 0;
  WATCHDOG_LOCK = 0;
}
