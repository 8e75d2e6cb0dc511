/* Counts the instructions of an emulated 64-bit ARM program by kind: a plugin of qemu-user.
 *
 * Whenever the program calls getpriority, the counts so far are printed to stderr, one line, so
 * that it can mark what it wants to have counted. Several threads may add to one counter at the
 * same time and lose counts: count programs that compute in one.
 */

#include <inttypes.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

/* The part of qemu's plugin interface, version 1, that is used here. */
typedef uint64_t plugin_id;
struct block;
struct instruction;
void qemu_plugin_register_vcpu_tb_trans_cb(plugin_id, void (*)(plugin_id, struct block *));
void qemu_plugin_register_vcpu_syscall_cb(plugin_id,
    void (*)(plugin_id, unsigned, int64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t,
             uint64_t, uint64_t, uint64_t));
void qemu_plugin_register_vcpu_tb_exec_inline(struct block *, int, void *, uint64_t);
size_t qemu_plugin_tb_n_insns(const struct block *);
struct instruction *qemu_plugin_tb_get_insn(const struct block *, size_t);
const void *qemu_plugin_insn_data(const struct instruction *);

int qemu_plugin_version = 1;

enum { ADD = 0, GETPRIORITY = 141 };

enum kind {
    FLOAT_PRODUCT,
    DOT_PRODUCT,
    INTEGER_PRODUCT,
    VECTOR,
    VECTOR_MEMORY,
    MEMORY,
    OTHER,
    KINDS
};

static uint64_t counts[KINDS];

static unsigned bits(uint32_t word, int last, int first)
{
    return (word >> first) & ((1u << (last - first + 1)) - 1);
}

/* Arm Architecture Reference Manual, "A64 instruction set encoding". */
static enum kind of_vectors(uint32_t word)
{
    unsigned four = bits(word, 15, 12), five = bits(word, 15, 11);

    if (word >> 31)
        return VECTOR;
    if (bits(word, 28, 24) == 15 && !bits(word, 10, 10)) { /* by element */
        if (four == 14 || four == 15)
            return DOT_PRODUCT;
        if (bits(word, 29, 29) == 0 && (four == 1 || four == 5 || four == 9))
            return FLOAT_PRODUCT;
        return INTEGER_PRODUCT;
    }
    if (bits(word, 28, 24) != 14)
        return VECTOR;
    if (bits(word, 21, 21) && bits(word, 10, 10)) { /* three of the same length */
        if (five == 25 || five == 27)
            return FLOAT_PRODUCT;
        return five == 18 || five == 19 || five == 22 ? INTEGER_PRODUCT : VECTOR;
    }
    if (bits(word, 21, 21) && !bits(word, 11, 10)) /* three of different lengths */
        return four >= 8 ? INTEGER_PRODUCT : VECTOR;
    if (!bits(word, 21, 21) && bits(word, 15, 15) && bits(word, 10, 10)) { /* extension */
        unsigned operation = bits(word, 14, 11);
        return operation >= 2 && operation <= 5 ? DOT_PRODUCT : VECTOR;
    }
    return VECTOR;
}

enum kind kind_of(uint32_t word)
{
    unsigned group = bits(word, 28, 25);

    if ((group & 5) == 4)
        return bits(word, 26, 26) ? VECTOR_MEMORY : MEMORY;
    return (group & 7) == 7 ? of_vectors(word) : OTHER;
}

static void translated(plugin_id id, struct block *block)
{
    uint64_t found[KINDS] = {0};

    (void)id;
    for (size_t at = 0; at < qemu_plugin_tb_n_insns(block); at++) {
        const void *word = qemu_plugin_insn_data(qemu_plugin_tb_get_insn(block, at));
        found[kind_of(*(const uint32_t *)word)]++;
    }
    for (int kind = 0; kind < KINDS; kind++)
        if (found[kind])
            qemu_plugin_register_vcpu_tb_exec_inline(block, ADD, &counts[kind], found[kind]);
}

static void called(plugin_id id, unsigned cpu, int64_t number, uint64_t a, uint64_t b, uint64_t c,
                   uint64_t d, uint64_t e, uint64_t f, uint64_t g, uint64_t h)
{
    (void)id, (void)cpu, (void)a, (void)b, (void)c, (void)d, (void)e, (void)f, (void)g, (void)h;
    if (number != GETPRIORITY)
        return;
    fputs("instructions", stderr);
    for (int kind = 0; kind < KINDS; kind++)
        fprintf(stderr, " %" PRIu64, counts[kind]);
    fputs("\n", stderr);
}

int qemu_plugin_install(plugin_id id, const void *info, int argc, char **argv)
{
    (void)info, (void)argc, (void)argv;
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    qemu_plugin_register_vcpu_syscall_cb(id, called);
    return 0;
}
