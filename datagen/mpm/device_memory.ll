; Floats at an address, as a number, and an entry from there: Taichi's own ways to an array look up where it lies anew
; after each store, do not say that it lies in a GPU's global memory, and know no four at once. Compiled for an unknown
; place, an atomic sum waits for an answer. Arguments are pointers, since Taichi passes its variables so.
;
; Assembled into device_memory.bc by LLVM 14, which Taichi's LLVM 15 reads: see tests/datagen/mpm/test_device_memory.py.

target datalayout = "e-i64:64-i128:128-v16:16-v32:32-n16:32:64"
target triple = "nvptx64-nvidia-cuda"

define internal float addrspace(1)* @memory_place(i64* %base, i32* %entry) alwaysinline {
  %from = load i64, i64* %base
  %index = load i32, i32* %entry
  %wide = sext i32 %index to i64
  %bytes = shl i64 %wide, 2
  %address = add i64 %from, %bytes
  %place = inttoptr i64 %address to float addrspace(1)*
  ret float addrspace(1)* %place
}

define void @memory_load(i64* %base, i32* %entry, float* %out) alwaysinline {
  %place = call float addrspace(1)* @memory_place(i64* %base, i32* %entry)
  %value = load float, float addrspace(1)* %place
  store float %value, float* %out
  ret void
}

define void @memory_store(i64* %base, i32* %entry, float* %in) alwaysinline {
  %place = call float addrspace(1)* @memory_place(i64* %base, i32* %entry)
  %value = load float, float* %in
  store float %value, float addrspace(1)* %place
  ret void
}

define void @memory_add(i64* %base, i32* %entry, float* %in) alwaysinline {
  %place = call float addrspace(1)* @memory_place(i64* %base, i32* %entry)
  %value = load float, float* %in
  %before = atomicrmw fadd float addrspace(1)* %place, float %value monotonic
  ret void
}

define void @memory_load4(i64* %base, i32* %entry, float* %x, float* %y, float* %z, float* %w) alwaysinline {
  %one = call float addrspace(1)* @memory_place(i64* %base, i32* %entry)
  %place = bitcast float addrspace(1)* %one to <4 x float> addrspace(1)*
  %values = load <4 x float>, <4 x float> addrspace(1)* %place, align 16
  %value0 = extractelement <4 x float> %values, i32 0
  %value1 = extractelement <4 x float> %values, i32 1
  %value2 = extractelement <4 x float> %values, i32 2
  %value3 = extractelement <4 x float> %values, i32 3
  store float %value0, float* %x
  store float %value1, float* %y
  store float %value2, float* %z
  store float %value3, float* %w
  ret void
}

define void @memory_store4(i64* %base, i32* %entry, float* %x, float* %y, float* %z, float* %w) alwaysinline {
  %one = call float addrspace(1)* @memory_place(i64* %base, i32* %entry)
  %place = bitcast float addrspace(1)* %one to <4 x float> addrspace(1)*
  %value0 = load float, float* %x
  %value1 = load float, float* %y
  %value2 = load float, float* %z
  %value3 = load float, float* %w
  %values0 = insertelement <4 x float> undef, float %value0, i32 0
  %values1 = insertelement <4 x float> %values0, float %value1, i32 1
  %values2 = insertelement <4 x float> %values1, float %value2, i32 2
  %values = insertelement <4 x float> %values2, float %value3, i32 3
  store <4 x float> %values, <4 x float> addrspace(1)* %place, align 16
  ret void
}
